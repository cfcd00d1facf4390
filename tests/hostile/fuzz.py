"""Fuzz a reader: `python -m tests.hostile.fuzz READER --runs N [--seed 0] [--crashes FOLDER] [--guided]`.

Every input gives an object or a `GwError`; anything else ends the run and leaves the input as a file. An
audit hook ends it too when the reader starts a process, opens a socket, writes a file or loads a package.
With --guided, atheris (libFuzzer) looks for inputs that reach new code.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

_FORBIDDEN = (
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "socket.connect",
    "socket.bind",
)


class Reached(BaseException):
    """A reader reached for something it has no business with."""


class Guard:
    """Audit hook that is armed while a reader runs."""

    def __init__(self, folder: str) -> None:
        self.folder, self.armed = folder, False
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.armed:
            return
        if event in _FORBIDDEN or (event == "import" and _is_foreign(str(arguments[0]))):
            raise Reached(f"{event} {arguments[:2]}")
        if event == "open" and isinstance(arguments[1], str) and any(c in arguments[1] for c in "wax+"):
            raise Reached(f"{event} {arguments[:2]}")


def _is_foreign(module: str) -> bool:
    """Whether a module belongs to a package that was not loaded before."""
    package = module.partition(".")[0]
    return package not in sys.stdlib_module_names and package not in sys.modules


class Trial:
    """One reader on one input after the other."""

    def __init__(self, name: str, crashes: Path | None) -> None:
        from tests.hostile.readers import READERS

        self.reader, self.name, self.crashes = READERS[name], name, crashes
        shared = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(prefix="gw-fuzz-", dir=shared if shared.is_dir() else None))
        self.path = self.folder / self.reader.file
        self.counts = {"runs": 0, "objects": 0, "refused": 0}
        self.slowest = 0.0
        self.good = self.reader.good()
        self.guard = Guard(str(self.folder))
        # Loads what the reader loads lazily, for a good file and for a bad one.
        for data in (self.good, self.good[: len(self.good) // 2], b""):
            self._read(self.reader.file_of(data))

    def one(self, data: bytes) -> None:
        """Read one input."""
        data = self.reader.file_of(data)
        started = time.process_time()
        self.guard.armed = True
        try:
            outcome = self._read(data)
        except BaseException:
            self.guard.armed = False
            if self.crashes is not None:
                self.crashes.mkdir(parents=True, exist_ok=True)
                (self.crashes / f"{self.name}-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)
            raise
        finally:
            self.guard.armed = False
        self.slowest = max(self.slowest, time.process_time() - started)
        self.counts["runs"] += 1
        self.counts[outcome] += 1

    def _read(self, data: bytes) -> str:
        from stages.shared.errors import GwError

        descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.write(descriptor, data)
        os.close(descriptor)
        try:
            self.reader.read(self.path)
        except GwError as error:
            assert error.what and error.where and error.fix
            return "refused"
        return "objects"


def mutated(trial: Trial, runs: int, seed: int) -> None:
    """Changed, cut and doubled good files."""
    import numpy as np

    from tests.hostile.test_capture_mutations import mutate

    random = np.random.default_rng(seed)
    for _ in range(runs):
        trial.one(mutate(trial.good, random))


def guided(trial: Trial, runs: int, seed: int) -> None:
    """libFuzzer by atheris; it ends the process itself."""
    import atheris

    corpus = trial.folder / "corpus"
    corpus.mkdir()
    (corpus / "good").write_bytes(trial.good)

    def test_one_input(data: bytes) -> None:
        trial.one(data)
        if trial.counts["runs"] >= runs:
            report(trial)
            os._exit(0)

    words = [
        sys.argv[0],
        str(corpus),
        f"-runs={2 * runs}",
        f"-seed={seed + 1}",
        f"-max_len={len(trial.good) + 4096}",  # or a longer one would be cut, and never be read to its end
        "-verbosity=0",
    ]
    atheris.Setup(words, test_one_input)
    atheris.Fuzz()


def report(trial: Trial) -> None:
    sys.stdout.write(
        json.dumps({trial.name: {**trial.counts, "slowest_seconds": round(trial.slowest, 3)}}) + "\n"
    )
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("reader", help="name, or all")
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--crashes", type=Path)
    parser.add_argument("--guided", action="store_true")
    options = parser.parse_args()
    if options.guided:
        import atheris

        with atheris.instrument_imports(include=["stages"]):
            from tests.hostile import readers
    else:
        from tests.hostile import readers
    names = list(readers.READERS) if options.reader == "all" else [options.reader]
    for name in names:
        trial = Trial(name, options.crashes)
        if options.guided:
            guided(trial, options.runs, options.seed)
        else:
            mutated(trial, options.runs, options.seed)
            report(trial)


if __name__ == "__main__":
    main()

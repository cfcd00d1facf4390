"""Run every case of a folder and print which are answered as expected: `python -m tests.cases FOLDER`.

Each case is a folder with `cmd.sh` and its input, in a folder of its kind. Set DEMO to a finished `gw demo`
for the cases that need one; without it they are skipped. FFMPEG names an ffmpeg for the case that looks into
a film. A case without a written expectation is right when no bug is reported. Ends with 1 when a case is
wrong.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.cases.expectations import BEFORE, RULES

REPOSITORY = Path(__file__).resolve().parents[2]
NEVER = ("A bug in gw", "Traceback (most recent call last)", "gw: command not found")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="only cases whose names contain one of these")
    parser.add_argument("--seconds", type=float, default=600, help="longest time for one case")
    options = parser.parse_args()
    cases = sorted(path.parent for path in options.folder.glob("*/*/cmd.sh"))
    cases = [case for case in cases if not options.names or any(name in case.name for name in options.names)]
    wrong = 0
    for case in cases:
        started = time.monotonic()
        verdict = judge(case, options.seconds)
        wrong += verdict.startswith("wrong")
        name = f"{case.parent.name}/{case.name}"
        sys.stdout.write(f"{name:48} {time.monotonic() - started:6.1f} s  {verdict}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{len(cases)} cases, {wrong} wrong\n")
    return 1 if wrong else 0


def judge(case: Path, seconds: float) -> str:
    """One line: "right", "wrong: …" or "skipped: …"."""
    command = (case / "cmd.sh").read_text()
    for name in ("DEMO", "FFMPEG"):
        if name not in os.environ and re.search(rf"\$\{{?{name}\b", BEFORE.get(case.name, "") + command):
            return f"skipped: {name} is not set"
    output = run(case, seconds)
    if output is None:
        return f"wrong: not finished after {seconds:.0f} s"
    for text in NEVER:
        if text in output:
            return f"wrong: {text}"
    for rule in RULES.get(case.name, ()):
        forbidden, pattern = rule.startswith("!"), rule.removeprefix("!")
        if bool(re.search(pattern, output)) == forbidden:
            return f"wrong: {'has' if forbidden else 'lacks'} {pattern!r}"
    return "right" if case.name in RULES else "right: no bug reported, no expectation is written down"


def run(case: Path, seconds: float) -> str | None:
    """Output of the command in a copy of the case; None when it takes too long."""
    with tempfile.TemporaryDirectory() as scratch:
        # Commands name files beside them, and some of the collection two folders above.
        root = Path(scratch) / "shared" / "cases" / case.parent.name
        root.mkdir(parents=True)
        shutil.copytree(case, root / case.name)
        for folder in root.glob("**/*"):
            folder.chmod(folder.stat().st_mode | 0o200)
        if (case.parent / "_tools").is_dir():
            shutil.copytree(case.parent / "_tools", root / "_tools")
        if (body := case.parents[2] / "body").is_dir():
            (Path(scratch) / "shared" / "body").symlink_to(body.resolve())
        out = Path(scratch) / "out"
        out.mkdir()
        paths = {
            "OUT": str(out),
            "REPO": str(REPOSITORY),
            "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(root / "_tools")]),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        }
        # With job control, jobs in the background can be interrupted as in a terminal. The output goes to a
        # file because a server that is left running would keep a pipe open.
        with (Path(scratch) / "output.txt").open("w+", errors="replace") as output:
            process = subprocess.Popen(
                ["bash", "-c", f"set -m\n{BEFORE.get(case.name, '')}\n. ./cmd.sh"],
                cwd=root / case.name,
                env={**os.environ, **paths},
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                return None
            finally:
                end_session(process.pid)
                process.wait()
            output.seek(0)
            return output.read()


def end_session(leader: int) -> None:
    """Kill what a case has left running: every process of its session."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            session = int(status.read_text().rpartition(")")[2].split()[3])
            if session == leader:
                os.kill(int(status.parent.name), signal.SIGKILL)
        except OSError:  # it has ended since
            continue


if __name__ == "__main__":
    sys.exit(main())

"""Values out of pickle files, without unpickling anything in this process (see `quarantine.py`)."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np

from stages.shared.artifacts.arrays import decode_arrays
from stages.shared.errors import BadData, MissingInput, StorageFailure

MAX_FILE_BYTES: Final = 512 << 20
_PROGRAM: Final = Path(__file__).with_name("quarantine.py")
_SECONDS: Final = 120.0
_MAX_ANSWER: Final = 2 * MAX_FILE_BYTES


class PickleReader:
    """A child process that turns pickles of arrays and plain containers into values; use it with `with`.

    Arguments:
        seconds: longest time that one file may take.
    """

    def __init__(self, seconds: float = _SECONDS) -> None:
        self._seconds = seconds
        self._child = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_PROGRAM)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={},
            close_fds=True,
            cwd="/",
        )

    def __enter__(self) -> PickleReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                pipe.close()

    def read(self, path: Path) -> Any:
        """What a pickle file holds: numbers, texts, None, lists, dictionaries with text keys, numpy arrays.

        Raises:
            MissingInput: no such file.
            BadData: anything else in it, damaged, too large, too slow.
        """
        if not path.is_file():
            raise MissingInput("A file of the capture is not there.", str(path), "Copy the capture again.")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BadData(
                "The pickle is larger than 512 MiB.", str(path), "Check that this is the right file."
            )
        try:
            data = path.read_bytes()
        except OSError as error:
            raise StorageFailure(
                f"Reading failed: {error.strerror}.", str(path), "Check the permissions."
            ) from error
        good, answer = self._ask(data, path)
        if not good:
            raise _refusal(path, "it holds " + bytes(answer).decode("utf-8", "replace"))
        arrays, notes = decode_arrays(answer, path)
        try:
            return _rebuild(json.loads(notes["tree"]), arrays)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise _refusal(path, "its content does not fit together") from error

    def _ask(self, data: bytes, path: Path) -> tuple[bool, bytearray]:
        requests, answers = self._child.stdin, self._child.stdout
        assert requests is not None and answers is not None
        alarm = threading.Timer(self._seconds, self._child.kill)
        alarm.start()
        try:
            requests.write(struct.pack("<Q", len(data)))
            requests.write(data)
            requests.flush()
            opening = answers.read(9)
            if len(opening) < 9:
                raise _refusal(path, "reading it took too long, or reached for something outside")
            length = struct.unpack("<Q", opening[1:])[0]
            if length > _MAX_ANSWER:
                raise _refusal(path, "it holds too much")
            answer = bytearray(answers.read(length))
            if len(answer) < length:
                raise _refusal(path, "reading it took too long")
            return opening[0] == 0, answer
        except OSError as error:
            raise _refusal(path, "reading it took too long, or reached for something outside") from error
        finally:
            alarm.cancel()


def _rebuild(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "array":
        return arrays[content] if content in arrays else arrays[content + "T"].T
    if kind == "list":
        return [_rebuild(part, arrays) for part in content]
    if kind == "dict":
        return {key: _rebuild(part, arrays) for key, part in content.items()}
    raise ValueError(kind)


def _refusal(path: Path, reason: str) -> BadData:
    return BadData(
        f"The pickle is refused: {reason}.",
        str(path),
        "Pickles can run code when opened: use only files of the data set's owners. Get this one again.",
    )


def dictionary(value: Any, path: Path) -> dict[str, Any]:
    """What was read from `path`, if it is a dictionary. Raises BadData otherwise."""
    if not isinstance(value, dict):
        raise BadData("The file does not hold a dictionary.", str(path), "Get the file again.")
    return value


def array_of(content: dict[str, Any], name: str, path: Path) -> np.ndarray:
    """The array (or list of numbers) of that name. Raises BadData where there is none."""
    value = content.get(name)
    if isinstance(value, list):
        value = np.asarray(value) if all(isinstance(item, int | float) for item in value) else None
    if not isinstance(value, np.ndarray):
        raise BadData(f"{name} is missing or no array.", str(path), "Get the file again.")
    return value

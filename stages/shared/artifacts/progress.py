"""Unfinished work of a long stage that survives a kill: files that are replaced atomically."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from stages.shared.artifacts.arrays import Arrays, decode_arrays, encode_arrays
from stages.shared.artifacts.canonical import canonical_json, digest, readable_json, strict_json
from stages.shared.artifacts.files import append_whole, write_whole
from stages.shared.artifacts.manifest import is_plain_name
from stages.shared.errors import BadData

_DIGEST_NOTE = "content_sha256"


class Progress:
    """Context manager holding the workspace's lock; what is in its folder is there again after a crash.

    Every file is replaced whole. What belongs together (weights, moments, the step they are of) goes into one
    file: `write_arrays(name, arrays, note)`.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path, release: Callable[[], None]) -> None:
        self.path = path
        self._release: Callable[[], None] | None = release
        self._ended: set[Path] = set()  # files whose last line is known to be whole

    def has(self, name: str) -> bool:
        """Whether a file of this name was written."""
        return self._path(name).is_file()

    def folder(self, name: str) -> Path:
        """A folder inside this one, made if it is not there."""
        folder = self._path(name)
        folder.mkdir(exist_ok=True)
        return folder

    def write_arrays(self, name: str, arrays: Mapping[str, Any], note: Any = None) -> None:
        """Replace a safetensors file; `note` (JSON types) is stored in the same file.

        Raises:
            BadData: a value is not finite. StorageFailure: disk full; the earlier file stays.
        """
        notes = {"note": canonical_json(note).decode(), _DIGEST_NOTE: _content_digest(arrays, note)}
        write_whole(self._path(name), encode_arrays(arrays, name, notes))

    def arrays(self, name: str) -> tuple[Arrays, Any]:
        """Arrays and note of a file written by `write_arrays`.

        Raises:
            BadData: damaged.
        """
        path = self._path(name)
        arrays, notes = decode_arrays(bytearray(path.read_bytes()), path)
        try:
            note = strict_json(notes["note"].encode())
        except (KeyError, ValueError) as error:
            raise self._damaged(path) from error
        if notes.get(_DIGEST_NOTE) != _content_digest(arrays, note):
            raise self._damaged(path)
        return arrays, note

    def write_json(self, name: str, value: Any) -> None:
        """Replace a JSON file."""
        write_whole(self._path(name), readable_json(value))

    def json(self, name: str) -> Any:
        """Content of a JSON file. Raises BadData when damaged."""
        path = self._path(name)
        try:
            return strict_json(path.read_bytes())
        except ValueError as error:
            raise self._damaged(path) from error

    def write_bytes(self, name: str, data: bytes) -> None:
        """Replace a file."""
        write_whole(self._path(name), data)

    def append_line(self, name: str, value: Any) -> None:
        """Add one JSON object as a line, in a single write. Survives a kill, not a power cut."""
        path = self._path(name)
        if path not in self._ended and path.exists():
            self.rewrite_lines(name, self.lines(name))
        self._ended.add(path)
        append_whole(path, canonical_json(value) + b"\n")

    def lines(self, name: str) -> list[Any]:
        """The lines appended so far, without one that a crash cut short."""
        path = self._path(name)
        if not path.exists():
            return []
        try:
            return [strict_json(line) for line in path.read_bytes().split(b"\n")[:-1]]
        except ValueError as error:
            raise self._damaged(path) from error

    def rewrite_lines(self, name: str, values: list[Any]) -> None:
        """Replace all lines, e.g. to drop those behind the checkpoint that is resumed from."""
        self._ended.add(self._path(name))
        write_whole(self._path(name), b"".join(canonical_json(value) + b"\n" for value in values))

    def close(self) -> None:
        """Let other processes write to the workspace; the folder stays."""
        if self._release is not None:
            self._release()
            self._release = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _path(self, name: str) -> Path:
        if not is_plain_name(name):
            raise ValueError(f"{name!r} cannot be the name of a file here")
        return self.path / name

    @staticmethod
    def _damaged(path: Path) -> BadData:
        return BadData(
            "A file of unfinished work is damaged.",
            str(path),
            "Run the same command with --force to start again.",
        )


def _content_digest(arrays: Mapping[str, Any], note: Any) -> str:
    """SHA-256 over names, types, shapes and values."""
    parts = {
        name: [digest(chunk) for chunk in encode_arrays({name: array}, name)]
        for name, array in arrays.items()
    }
    return digest(canonical_json({"arrays": parts, "note": note}))

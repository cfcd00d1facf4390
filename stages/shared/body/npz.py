"""Numbers out of an `.npz` that somebody else wrote: lazily, bounded, never an object."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData, MissingInput

_PICKLE_MAGIC = b"\x80"
_ZIP_MAGIC = b"PK\x03\x04"

# What a spoiled archive can raise; RuntimeError and NotImplementedError (a kind of it) where it claims to be
# encrypted, or packed in a way that this Python does not know.
_UNREADABLE = (ValueError, EOFError, OSError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)


class NumericNpz:
    """One open `.npz`; arrays are read when asked for, the others are never touched.

    Arguments:
        path: the file.
        what: what it should be, in words for an error message ("a body model").
        limit: largest size in bytes that one array may have after unpacking.

    Raises:
        MissingInput: there is no such file.
        BadData: it is a pickle, not a zip, or damaged; from `array` also when an array is missing, holds
            objects, is larger than `limit`, or contains NaN or infinity.
    """

    def __init__(self, path: Path, what: str, limit: int = 1 << 30) -> None:
        self.path, self.what, self.limit = Path(path), what, limit
        if not self.path.is_file():
            raise MissingInput(f"There is no file for {what}.", str(path), "Check the path.")
        with self.path.open("rb") as stream:
            magic = stream.read(4)
        if magic[:1] == _PICKLE_MAGIC:
            raise BadData(
                f"This file is a Python pickle, which can run code when opened; {what} must be a plain .npz.",
                str(path),
                "Load it once where you trust it and save the numeric arrays with numpy.savez.",
            )
        if magic != _ZIP_MAGIC:
            raise self._broken("it does not begin like a zip archive")
        try:
            self._archive = zipfile.ZipFile(self.path)
        except _UNREADABLE as error:
            raise self._broken(str(error)) from error
        self.names = frozenset(
            name.removesuffix(".npy") for name in self._archive.namelist() if name.endswith(".npy")
        )

    def __enter__(self) -> NumericNpz:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._archive.close()

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def array(self, name: str, finite: bool = True) -> NDArray[np.generic]:
        """The array called `name`, of any numeric or string type."""
        if name not in self.names:
            have = ", ".join(sorted(self.names)[:20]) or "nothing"
            raise BadData(
                f"{self._sentence()} lacks the array {name!r}.", f"{self.path} (it has: {have})", self._fix()
            )
        try:
            with self._archive.open(name + ".npy") as stream:
                shape, dtype = _header(stream)
                if dtype.hasobject:
                    raise BadData(
                        f"The array {name!r} holds Python objects, not numbers.",
                        str(self.path),
                        "Save it as a plain (dense) numeric array.",
                    )
                size = int(np.prod(shape, dtype=object)) * dtype.itemsize
                if size > self.limit:
                    raise BadData(
                        f"The array {name!r} would take {size / 2**20:.0f} MiB, more than fits {self.what}.",
                        f"{self.path}: {name} {shape}",
                        self._fix(),
                    )
            with self._archive.open(name + ".npy") as stream:
                values = np.lib.format.read_array(stream, allow_pickle=False)
        except _UNREADABLE as error:
            raise self._broken(f"{name}: {error}") from error
        if finite and values.dtype.kind == "f" and not np.isfinite(values).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
            raise BadData(
                f"The array {name!r} contains NaN or infinity.",
                f"{self.path}: {name}{list(where)}",
                self._fix(),
            )
        return values

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of the array `name`, from its header alone."""
        try:
            with self._archive.open(name + ".npy") as stream:
                return _header(stream)[0]
        except (KeyError, *_UNREADABLE) as error:
            raise self._broken(f"{name}: {error}") from error

    def _sentence(self) -> str:
        return self.what[:1].upper() + self.what[1:]

    def _fix(self) -> str:
        return f"Give a complete file for {self.what}."

    def _broken(self, reason: str) -> BadData:
        return BadData(f"This file cannot be read as {self.what}: {reason}.", str(self.path), self._fix())


def _header(stream: object) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)  # type: ignore[arg-type]
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)  # type: ignore[arg-type]
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)  # type: ignore[arg-type]
    return shape, dtype

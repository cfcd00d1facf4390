"""Numbers from an `.npz` of unknown origin: read on demand, bounded in size, never as Python objects."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.input_files import check_input_file

_PICKLE_MAGIC = b"\x80"
_ZIP_MAGIC = b"PK\x03\x04"
# Up to this size an array may be packed as tightly as it will; a larger one may be this many times its
# packed size.
_FREE_BYTES = 64 << 20
_LARGEST_RATIO = 50

# What a spoiled archive can raise; RuntimeError and NotImplementedError (a kind of it) where it claims to be
# encrypted, or packed in a way that this Python does not know.
_UNREADABLE = (
    ValueError,
    TypeError,
    EOFError,
    OSError,
    RuntimeError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)


class NumericNpz:
    """One open `.npz`; arrays are read when asked for, the others are never touched.

    Arguments:
        path: the file.
        what: what it should be, in words for an error message ("a body model").
        limit: largest size in bytes that one array may have after unpacking.

    Raises:
        MissingInput: there is no such file.
        BadData: it is not a regular file, a pickle, not a zip, or damaged; from `array` also when an array
            is missing, holds objects, is larger than `limit`, or contains NaN or infinity.
    """

    def __init__(self, path: Path, what: str, limit: int = 1 << 30) -> None:
        self.path, self.what, self.limit = Path(path), what, limit
        check_input_file(self.path, what)
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
                packed = self._archive.getinfo(name + ".npy").compress_size
                if size > _FREE_BYTES and size > _LARGEST_RATIO * packed:
                    raise BadData(
                        f"The array {name!r} would grow from {packed} bytes to {size / 2**20:.0f} MiB.",
                        f"{self.path}: {name} {shape}",
                        "Save it again without compression, if it really holds that much.",
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

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The array called `name` in double precision.

        Raises:
            BadData: also for text, bytes, truth values, complex numbers and records, and for numbers that are
                not finite in double precision.
        """
        values = self.array(name, finite=False)
        if values.dtype.kind not in "fiu":
            raise BadData(
                f"{name} is not numeric: its type is {_kind(values.dtype)}.",
                f"{self.path}: {name}",
                "Store plain real numbers.",
            )
        with np.errstate(over="ignore"):
            doubles = values.astype(np.float64)
        if not np.isfinite(doubles).all():
            index = [int(i) for i in np.argwhere(~np.isfinite(doubles))[0]]
            raise BadData(
                f"The array {name!r} contains NaN or infinity.", f"{self.path}: {name}{index}", self._fix()
            )
        return doubles

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of the array `name`, from its header alone."""
        if name not in self.names:
            self.array(name)  # raises: it lists what the file has
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
    if any(type(side) is not int or side < 0 for side in shape):
        raise ValueError(f"{shape} is not a shape")
    return shape, dtype


def _kind(dtype: np.dtype[np.generic]) -> str:
    names = {
        "b": "truth values",
        "c": "complex numbers",
        "V": "records",
        "S": "bytes",
        "U": "text",
        "O": "objects",
    }
    return names.get(dtype.kind, str(dtype))

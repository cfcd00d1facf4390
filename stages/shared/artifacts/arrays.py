"""Arrays on disk as safetensors: the same content gives the same bytes, and a reader checks every header.

Layout of a file: 8 bytes little-endian header length, a JSON header (name to dtype, shape, offsets), then the
arrays without gaps. Wider types come first, so every array is aligned and is used without a copy.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts.canonical import canonical_json, strict_json
from stages.shared.errors import BadData

MAX_HEADER_BYTES = 1 << 20
MAX_RANK = 8
_DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "|i1",
    "U64": "<u8",
    "U32": "<u4",
    "U16": "<u2",
    "U8": "|u1",
    "BOOL": "|b1",
}
_NAMES = {np.dtype(dtype): name for name, dtype in _DTYPES.items()}
Arrays = dict[str, np.ndarray]


def encode_arrays(
    arrays: Mapping[str, Any], where: str, notes: Mapping[str, str] | None = None
) -> list[memoryview]:
    """The bytes of a safetensors file, as chunks that can be written one after the other.

    Arguments:
        arrays: name to array; anything numpy takes.
        where: file name for error messages.
        notes: short texts kept in the header.

    Raises:
        BadData: a value that is not finite, or a type that has no place in a file.
    """
    ready = {name: _ready(name, array, where) for name, array in arrays.items()}
    ordered = sorted(ready, key=lambda name: (-ready[name].dtype.itemsize, name))
    header: dict[str, Any] = {"__metadata__": dict(notes)} if notes else {}
    position = 0
    for name in ordered:
        array = ready[name]
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [position, position + array.nbytes],
        }
        position += array.nbytes
    text = canonical_json(header)
    text += b" " * (-len(text) % 8)
    if len(text) > MAX_HEADER_BYTES:
        raise BadData(
            f"The header takes {len(text)} bytes, more than {MAX_HEADER_BYTES}.", where, "Use fewer arrays."
        )
    chunks = [memoryview(struct.pack("<Q", len(text)) + text)]
    chunks += [ready[name].reshape(-1).view(np.uint8).data for name in ordered if ready[name].size]
    return chunks


def _ready(name: str, value: Any, where: str) -> np.ndarray:
    array = np.asarray(value)
    array = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(array.shape)
    if name == "__metadata__" or array.dtype not in _NAMES or array.ndim > MAX_RANK:
        raise BadData(
            f"An array of type {array.dtype} and rank {array.ndim} cannot be stored.",
            f"{where}, array {name!r}",
            "Convert it to a plain number type of at most rank 8.",
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        wrong = np.argwhere(~np.isfinite(array))
        raise BadData(
            f"{len(wrong)} of {array.size} values are not finite, the first at index {wrong[0].tolist()}.",
            f"{where}, array {name!r}",
            "Look at the inputs of this step; nothing was written.",
        )
    return array


def describe_arrays(arrays: Mapping[str, Any], about: Mapping[str, str]) -> dict[str, Any]:
    """What the manifest says of each array: shape, dtype, text of `about`, smallest and largest value.

    Arguments:
        about: texts by name; a stage gives the same texts for several files, so names may be missing here.
    """
    described = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        described[name] = {
            "shape": list(array.shape),
            "dtype": array.dtype.newbyteorder("=").name,
            "about": about.get(name, ""),
            "min": array.min().item() if array.size else None,
            "max": array.max().item() if array.size else None,
        }
    return described


def decode_arrays(data: bytearray, path: Path) -> tuple[Arrays, dict[str, str]]:
    """Arrays and notes of a safetensors file that was read into `data`; the arrays use its memory.

    Raises:
        BadData: naming the file and the array whose claim does not hold.
    """
    header, start = _header(data, path)
    notes = header.pop("__metadata__", {})
    if not isinstance(notes, dict) or not all(isinstance(text, str) for text in notes.values()):
        raise _damaged(path, "the notes in its header are not texts")
    spans = sorted((*_span(name, entry, path), name) for name, entry in header.items())
    expected = 0
    for begin, end, name in spans:
        if begin != expected:
            raise _damaged(path, f"its data does not begin where the last ended, at byte {expected}", name)
        expected = end
    if start + expected != len(data):
        raise _damaged(path, f"its arrays take {expected} bytes, but the file holds {len(data) - start}")
    arrays = {}
    for begin, end, name in spans:
        entry = header[name]
        dtype = np.dtype(_DTYPES[entry["dtype"]])
        flat = np.frombuffer(data, np.uint8, end - begin, start + begin)
        if dtype.kind == "b" and flat.size and flat.max() > 1:
            raise _damaged(path, "a truth value is neither 0 nor 1", name)
        array = flat.view(dtype) if (start + begin) % dtype.itemsize == 0 else flat.copy().view(dtype)
        arrays[name] = array.reshape(entry["shape"])
    return dict(sorted(arrays.items())), notes


def _header(data: bytearray, path: Path) -> tuple[dict[str, Any], int]:
    if len(data) < 8:
        raise _damaged(path, f"it is {len(data)} bytes long")
    (length,) = struct.unpack_from("<Q", data)
    if length > MAX_HEADER_BYTES or 8 + length > len(data):
        raise _damaged(path, f"its header claims {length} bytes")
    try:
        header = strict_json(bytes(data[8 : 8 + length]))
    except (ValueError, RecursionError) as error:
        raise _damaged(path, f"its header is not JSON ({error})") from error
    if not isinstance(header, dict):
        raise _damaged(path, "its header is not an object")
    return header, 8 + length


def _span(name: str, entry: Any, path: Path) -> tuple[int, int]:
    """Begin and end of one array, after a check that its shape, type and length agree."""
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
        raise _damaged(path, "its header entry is not dtype, shape and offsets", name)
    shape, offsets = entry["shape"], entry["data_offsets"]
    if not isinstance(entry["dtype"], str) or entry["dtype"] not in _DTYPES:
        raise _damaged(path, f"its type {entry['dtype']!r} is unknown", name)
    if not _is_counts(shape) or len(shape) > MAX_RANK:
        raise _damaged(path, f"its shape {shape!r} is not one", name)
    if not _is_counts(offsets) or len(offsets) != 2:
        raise _damaged(path, f"its offsets {offsets!r} are not two counts", name)
    count = 1
    for side in shape:
        count *= side
    if offsets[1] - offsets[0] != count * np.dtype(_DTYPES[entry["dtype"]]).itemsize:
        raise _damaged(path, f"its shape {shape} does not fill bytes {offsets[0]} to {offsets[1]}", name)
    return offsets[0], offsets[1]


def _is_counts(value: Any) -> bool:
    return isinstance(value, list) and all(type(item) is int and 0 <= item < 1 << 48 for item in value)


def _damaged(path: Path, what: str, array: str | None = None) -> BadData:
    return BadData(
        f"The file does not hold the arrays it should: {what}.",
        str(path) if array is None else f"{path}, array {array!r}",
        "Make it again, or fetch a whole copy; `gw verify` lists everything that is damaged.",
    )

"""GLB, the binary container of glTF 2.0: a JSON chunk that describes, a binary chunk that holds the numbers.

Format: Khronos, glTF 2.0 specification, sections 3.6 (accessors) and 4 (GLB).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts import write_whole
from stages.shared.errors import BadData, MissingInput
from stages.shared.input_files import strict_json

ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENT = {"<f4": 5126, "<u4": 5125, "<u2": 5123, "|u1": 5121, "<i2": 5122, "|i1": 5120}
_DTYPE = {code: np.dtype(name) for name, code in _COMPONENT.items()}
_KIND = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_SHAPE = {name: shape for shape, name in _KIND.items()}
_LONGEST = 1 << 31


class GlbWriter:
    """Collects arrays and the JSON that names them.

    `content` is the glTF object; fill in nodes, meshes and so on before `write`.
    """

    def __init__(self) -> None:
        self.content: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "gw"},
            "accessors": [],
            "bufferViews": [],
        }
        self._data = bytearray()

    def array(
        self,
        values: NDArray[Any],
        target: int | None = ARRAY_BUFFER,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Add an array (N,), (N, k) or (N, 4, 4); returns its accessor.

        Matrices are given row by row and stored column by column, as glTF has them. Rows of bytes must fill
        whole words of 4 bytes (section 3.6.2.4).

        Arguments:
            target: what the numbers are for (34962 vertices, 34963 faces), None for neither.
            bounds: state minimum and maximum, which positions and times need.
        """
        kind = _KIND[values.shape[1:]]
        stored = np.ascontiguousarray(values.swapaxes(1, 2) if kind == "MAT4" else values)
        stored = stored.astype(stored.dtype.newbyteorder("<"))
        accessor: dict[str, Any] = {
            "bufferView": self.data(stored.tobytes(), target),
            "componentType": _COMPONENT[stored.dtype.str],
            "count": len(values),
            "type": kind,
        }
        if normalized:
            accessor["normalized"] = True
        if bounds:
            accessor["min"] = np.atleast_1d(stored.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(stored.max(axis=0)).tolist()
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def data(self, content: bytes, target: int | None = None) -> int:
        """Add bytes, such as a picture; returns their buffer view."""
        self._data += b"\0" * (-len(self._data) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self._data += content
        self.content["bufferViews"].append(view)
        return len(self.content["bufferViews"]) - 1

    def write(self, path: Path) -> None:
        """Write the file whole or not at all."""
        self._data += b"\0" * (-len(self._data) % 4)
        content = {**self.content, "buffers": [{"byteLength": len(self._data)}]}
        text = json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self._data)
        head = struct.pack("<III", _MAGIC, 2, total) + struct.pack("<II", len(text), _JSON)
        write_whole(path, [head, text, struct.pack("<II", len(self._data), _BINARY), bytes(self._data)])


class GlbReader:
    """A GLB file with its binary chunk, for what `GlbWriter` writes.

    Raises MissingInput (no such file), BadData (another format, truncated, accessors outside the file).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise MissingInput("There is no such file.", str(path), "Check the path.") from None
        if len(data) < 20 or len(data) > _LONGEST:
            raise self._refused("of its size")
        magic, version, total, length, kind = struct.unpack_from("<IIIII", data)
        if magic != _MAGIC or version != 2 or total != len(data) or kind != _JSON or 20 + length > total:
            raise self._refused("of its header")
        try:
            self.content: dict[str, Any] = strict_json(data[20 : 20 + length])
        except ValueError as error:
            raise self._refused("its JSON cannot be read") from error
        if not isinstance(self.content, dict):
            raise self._refused("its JSON is no object")
        start = 20 + length
        if total < start + 8 or struct.unpack_from("<I", data, start + 4)[0] != _BINARY:
            raise self._refused("it has no binary chunk")
        self._data = memoryview(data)[start + 8 :]

    def array(self, accessor: int) -> NDArray[Any]:
        """The numbers of an accessor, (N,), (N, k) or (N, 4, 4)."""
        try:
            entry = self.content["accessors"][accessor]
            view = self.content["bufferViews"][entry["bufferView"]]
            dtype, shape = _DTYPE[entry["componentType"]], _SHAPE[entry["type"]]
            start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
            count = int(entry["count"]) * int(np.prod(shape, dtype=int))
            if view.get("byteStride") or start < 0:
                raise ValueError("interleaved")
            values = np.frombuffer(self._data, dtype, count, start).reshape(-1, *shape)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise self._refused(f"accessor {accessor} cannot be read ({error})") from error
        return values.swapaxes(1, 2) if shape == (4, 4) else values

    def _refused(self, why: str) -> BadData:
        return BadData(f"This is no GLB file that can be read: {why}.", str(self._path), "Export it again.")

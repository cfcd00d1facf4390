"""PLY meshes: a reader for ASCII and both byte orders with bounds, and a writer with reproducible bytes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.meshes.mesh import MAX_FACES, MAX_VERTICES, Mesh, MeshArrays

MAX_HEADER_BYTES: Final = 65_536
_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_COUNT: Final = 10 * max(MAX_VERTICES, MAX_FACES)


@dataclass
class _Property:
    name: str
    kind: str
    count_kind: str | None = None  # of a list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def fixed(self) -> bool:
        return all(item.count_kind is None for item in self.properties)


def decode_ply(data: bytes, where: str) -> MeshArrays:
    """The arrays of the mesh in the content of a PLY file; polygons are cut into fans of triangles.

    Read are x y z, red green blue (u8, or float 0..1), `label` per vertex, and the lists `vertex_indices` or
    `vertex_index` of the faces; all else is skipped.

    Raises:
        BadData: not a PLY, cut short, counts that do not fit the file.
    """
    order, elements, start = _header(data, where)
    columns: dict[str, NDArray[np.generic]] = {}
    faces = np.zeros((0, 3), np.int64)
    if order:
        position = start
        for element in elements:
            if element.fixed:
                table, position = _binary_table(data, position, element, order, where)
                if element.name == "vertex":
                    columns = {name: table[name] for name in table.dtype.names or ()}
            else:
                polygons, position = _binary_lists(data, position, element, order, where)
                if element.name == "face":
                    faces = polygons
    else:
        columns, faces = _ascii_body(data[start:], elements, where)
    return _arrays(columns, faces, where)


def encode_ply(mesh: Mesh, normals: NDArray[np.float32] | None = None) -> list[bytes]:
    """The content of a binary little-endian PLY, in pieces."""
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if normals is not None:
        fields += [("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    if mesh.colors is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    if mesh.labels is not None:
        fields += [("label", "u1")]
    table = np.zeros(len(mesh.vertices), dtype=fields)
    for axis, name in enumerate("xyz"):
        table[name] = mesh.vertices[:, axis]
        if normals is not None:
            table["n" + name] = normals[:, axis]
    if mesh.colors is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            table[name] = mesh.colors[:, channel]
    if mesh.labels is not None:
        table["label"] = mesh.labels
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return ["\n".join(lines).encode(), table.tobytes(), faces.tobytes()]


def _header(data: bytes, where: str) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise _bad("it does not begin with a PLY header", where)
    start = data.find(b"\n", end) + 1
    if start == 0:
        raise _bad("it ends with its header", where)
    order: str | None = None
    elements: list[_Element] = []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            order = _ORDERS[words[1]]
        elif (
            words[0] == "element" and len(words) == 3 and words[2].isdecimal() and int(words[2]) <= _MAX_COUNT
        ):
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
        elif (
            words[0] == "property" and elements and len(words) == 5 and words[1] == "list"
            and words[2] in _TYPES and words[3] in _TYPES and _TYPES[words[2]][0] in "iu"
        ):  # fmt: skip
            elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
        else:
            raise _bad(f"its header has the line {line.strip()[:60]!r}", where)
    if order is None:
        raise _bad("its header names no known format", where)
    for element in elements:
        names = [item.name for item in element.properties]
        if len(set(names)) != len(names):
            raise _bad(f"element {element.name} has a property twice", where)
    return order, elements, start


def _binary_table(
    data: bytes, position: int, element: _Element, order: str, where: str
) -> tuple[NDArray[np.void], int]:
    dtype = np.dtype([(item.name, order + item.kind) for item in element.properties])
    end = position + element.count * dtype.itemsize
    if end > len(data):
        raise _bad(
            f"it ends early: {element.count} x {element.name} take {end - len(data)} bytes more", where
        )
    return np.frombuffer(data, dtype, element.count, position), end


def _binary_lists(
    data: bytes, position: int, element: _Element, order: str, where: str
) -> tuple[NDArray[np.int64], int]:
    """Triangles (n, 3) of an element with lists: at once when all rows are equally long, else row by row."""
    counts = _first_row_counts(data, position, element, order)
    if counts is None:
        if element.count:
            raise _bad("it ends early, within its faces", where)
        return np.zeros((0, 3), np.int64), position
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for item, count in zip(element.properties, counts, strict=True):
        if count is None:
            fields.append((item.name, order + item.kind))
        else:
            fields += [
                ("#" + item.name, order + str(item.count_kind)),
                (item.name, order + item.kind, (count,)),
            ]
    dtype = np.dtype(fields)
    end = position + element.count * dtype.itemsize
    if end <= len(data):
        table = np.frombuffer(data, dtype, element.count, position)
        same = all(
            (table["#" + item.name] == count).all()
            for item, count in zip(element.properties, counts, strict=True)
            if count is not None
        )
        if same:
            name = _index_list(element)
            polygons = table[name].astype(np.int64) if name else np.zeros((0, 3), np.int64)
            return _fan(polygons), end
    return _binary_rows(data, position, element, order, where)


def _first_row_counts(data: bytes, position: int, element: _Element, order: str) -> list[int | None] | None:
    counts: list[int | None] = []
    for item in element.properties:
        if item.count_kind is None:
            counts.append(None)
            position += np.dtype(item.kind).itemsize
            continue
        size = np.dtype(item.count_kind).itemsize
        if position + size > len(data):
            return None
        count = int(np.frombuffer(data, order + item.count_kind, 1, position)[0])
        if not 0 <= count <= 255:
            return None
        counts.append(count)
        position += size + count * np.dtype(item.kind).itemsize
    return counts


def _binary_rows(
    data: bytes, position: int, element: _Element, order: str, where: str
) -> tuple[NDArray[np.int64], int]:
    name = _index_list(element)
    triangles: list[tuple[int, int, int]] = []
    for _ in range(element.count):
        for item in element.properties:
            length = 1
            if item.count_kind is not None:
                size = np.dtype(item.count_kind).itemsize
                if position + size > len(data):
                    raise _bad("it ends early, within its faces", where)
                length = int(np.frombuffer(data, order + item.count_kind, 1, position)[0])
                position += size
            end = position + length * np.dtype(item.kind).itemsize
            if not 0 <= length <= 255 or end > len(data):
                raise _bad("it ends early, or a face has more than 255 corners", where)
            if item.name == name:
                corners = np.frombuffer(data, order + item.kind, length, position).astype(np.int64).tolist()
                triangles += [(corners[0], corners[i], corners[i + 1]) for i in range(1, length - 1)]
            position = end
    return np.array(triangles, np.int64).reshape(-1, 3), position


def _ascii_body(
    data: bytes, elements: list[_Element], where: str
) -> tuple[dict[str, NDArray[np.generic]], NDArray[np.int64]]:
    lines = [line for line in data.decode("latin-1").splitlines() if line.strip()]
    columns: dict[str, NDArray[np.generic]] = {}
    triangles: list[tuple[int, int, int]] = []
    position = 0
    for element in elements:
        rows = lines[position : position + element.count]
        if len(rows) < element.count:
            raise _bad(f"it ends early: {len(rows)} of {element.count} x {element.name}", where)
        position += element.count
        try:
            if element.name == "vertex" and element.fixed and rows:
                values = np.array([row.split() for row in rows], dtype=np.float64)
                if values.shape[1] != len(element.properties):
                    raise ValueError(f"{values.shape[1]} values per vertex")
                columns = {
                    item.name: values[:, place] if item.kind[0] == "f" else values[:, place].astype(np.int64)
                    for place, item in enumerate(element.properties)
                }
            elif element.name == "face" and not element.fixed:
                triangles += [corner for row in rows for corner in _ascii_face(row.split(), element)]
        except (ValueError, IndexError, OverflowError) as error:
            raise _bad(f"its {element.name} rows cannot be read ({error})", where) from error
    return columns, np.array(triangles, np.int64).reshape(-1, 3)


def _ascii_face(words: list[str], element: _Element) -> list[tuple[int, int, int]]:
    name, position = _index_list(element), 0
    for item in element.properties:
        length = 1
        if item.count_kind is not None:
            length = int(words[position])
            position += 1
        values = words[position : position + length]
        if not 0 <= length <= 255 or len(values) < length:
            raise ValueError("a face with too few corners")
        if item.name == name:
            corners = [int(value) for value in values]
            return [(corners[0], corners[i], corners[i + 1]) for i in range(1, length - 1)]
        position += length
    return []


def _index_list(element: _Element) -> str | None:
    return next(
        (
            item.name
            for item in element.properties
            if item.count_kind is not None and item.name in ("vertex_indices", "vertex_index")
        ),
        None,
    )


def _fan(polygons: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of polygons (n, k): corner 0 with each pair of neighbours."""
    corners = polygons.shape[1]
    if corners < 3:
        return np.zeros((0, 3), np.int64)
    fans = [polygons[:, [0, i, i + 1]] for i in range(1, corners - 1)]
    return np.stack(fans, axis=1).reshape(-1, 3)


def _arrays(columns: dict[str, NDArray[np.generic]], faces: NDArray[np.int64], where: str) -> MeshArrays:
    if not all(axis in columns for axis in "xyz"):
        raise _bad("it has no vertices with x, y and z", where)
    vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if len(faces) and (faces.min() < -(2**31) or faces.max() >= 2**31):
        raise _bad("a face names an impossible vertex", where)
    colors = None
    if all(name in columns for name in ("red", "green", "blue")):
        channels = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
        if channels.dtype.kind == "f":
            channels = np.round(np.nan_to_num(channels) * 255.0)
        colors = np.clip(channels, 0, 255).astype(np.uint8)
    labels = None
    if "label" in columns:
        labels = np.clip(np.nan_to_num(columns["label"].astype(np.float64), nan=255), 0, 255).astype(np.uint8)
    return MeshArrays(vertices, faces.astype(np.int32), colors, labels)


def _bad(reason: str, where: str) -> BadData:
    return BadData(f"The PLY file cannot be read: {reason}.", where, "Export the mesh again as PLY.")

"""Reading and writing of mesh files."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.files import write_whole
from stages.shared.errors import BadData
from stages.shared.input_files import check_input_file, read_input, strict_json, without_mark
from stages.shared.meshes.mesh import Mesh, MeshArrays, check_mesh
from stages.shared.meshes.ply import decode_ply, encode_ply

MAX_FILE_BYTES: Final = 2 << 30
_FAR = 50.0  # sizes of a mesh between its middle and the origin
FORMATS: Final = (".ply", ".obj", ".stl", ".glb", ".off")


def load_mesh(path: Path) -> Mesh:
    """A mesh of a `.ply` (colours and `label` per vertex are kept), `.obj`, `.stl`, `.glb` or `.off` file.

    Raises:
        MissingInput: no such file.
        BadData: another format, damaged, NaN, no faces, more than 20 million vertices.
    """
    return check_mesh(_read(Path(path)).mesh(), str(path))


def load_centred_mesh(path: Path) -> tuple[Mesh, NDArray[np.float64]]:
    """A mesh as `load_mesh` reads it, moved to the origin if it is far away; and where its middle was (3,).

    32 bits cannot hold the details of a person at the coordinates of a map, so the shift is made in 64 bits.
    It is zero for a mesh near the origin.
    """
    arrays = _read(Path(path))
    vertices = arrays.vertices[np.isfinite(arrays.vertices).all(axis=1)]
    middle = np.zeros(3)
    if len(vertices):
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        if np.abs(low + high).max() / 2 > _FAR * (high - low).max():
            middle = np.round((low + high) / 2)
    return check_mesh(arrays.mesh(middle), str(path)), middle


def check_mesh_file(path: Path) -> None:
    """Raise MissingInput or BadData for what is no mesh file that could be read, without reading it."""
    suffix = path.suffix.lower()
    check_input_file(path, "a mesh", MAX_FILE_BYTES)
    if suffix not in FORMATS:
        raise BadData(
            f"Meshes of type {suffix or 'unknown'} are not read.", str(path), f"Use {', '.join(FORMATS)}."
        )


def write_ply(path: Path, mesh: Mesh, normals: NDArray[np.float32] | None = None) -> None:
    """Write a binary PLY, whole or not at all; the same mesh gives the same bytes.

    Raises:
        StorageFailure: disk full, no permission.
    """
    write_whole(Path(path), encode_ply(mesh, normals))


def _read(path: Path) -> MeshArrays:
    check_mesh_file(path)
    suffix = path.suffix.lower()
    data = without_mark(read_input(path, "a mesh", MAX_FILE_BYTES))
    return decode_ply(data, str(path)) if suffix == ".ply" else _decode_with_trimesh(data, suffix[1:], path)


def _decode_with_trimesh(data: bytes, kind: str, path: Path) -> MeshArrays:
    """All other formats; given as a stream without a folder, so that it cannot refer to other files."""
    import trimesh

    if kind == "glb":
        _check_glb_counts(data, path)
    options: dict[str, Any] = {"skip_materials": True} if kind == "obj" else {}
    try:
        loaded: Any = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False, **options)
        faces, vertices = np.asarray(loaded.faces), np.asarray(loaded.vertices)
        colors = _vertex_colors(loaded)
    except Exception as error:  # parsers of foreign formats fail in every way there is
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise BadData(f"The mesh cannot be read: {reason}.", str(path), "Export the mesh again.") from error
    if len(faces) and (faces.ndim != 2 or faces.shape[1] != 3):
        raise BadData("The mesh is not made of triangles.", str(path), "Export it with triangles.")
    if len(vertices) and (vertices.ndim != 2 or vertices.shape[1] != 3):
        raise BadData("The mesh's vertices are not points in space.", str(path), "Export the mesh again.")
    if kind == "stl" and len(vertices):
        vertices, faces = _weld(vertices, faces)  # STL repeats every corner
    return MeshArrays(vertices.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3), colors)


def _check_glb_counts(data: bytes, path: Path) -> None:
    """Refuse a header that claims more values than the file has bytes: they would be allocated."""
    try:
        (length,) = struct.unpack_from("<I", data, 12)
        accessors = strict_json(data[20 : 20 + length])["accessors"]
        counts = [int(accessor["count"]) for accessor in accessors]
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise BadData("The GLB file has no readable header.", str(path), "Export the mesh again.") from error
    if counts and max(counts) > len(data):
        raise BadData(
            f"The GLB file claims {max(counts)} values and holds {len(data)} bytes.",
            str(path),
            "Export the mesh again.",
        )


def _vertex_colors(loaded: Any) -> NDArray[np.uint8] | None:
    visual = getattr(loaded, "visual", None)
    if visual is None or visual.kind != "vertex":
        return None
    return np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)


def _weld(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)[faces]

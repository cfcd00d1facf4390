"""The simulation mesh of a garment: even triangles without slivers, openings left open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.meshes import Mesh, boundary_edges, components, edges, face_normals, keep_faces
from stages.shared.meshes.remesh import remesh

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]

SHORTEST_EDGE = 0.4  # of the target length; shorter edges are collapsed
_SMALLEST_PART = 0.02  # of all faces; smaller pieces of cloth are scan noise
_SMALLEST_AREA = 1e-8  # square metres of a face
_FEWEST_FACES = 40  # meshes of fewer faces are simulated as they are


def simulation_mesh(vertices: NDArray, faces: NDArray, edge: float) -> tuple[Doubles, Indices]:
    """An isotropic mesh of a garment without slivers and without scattered pieces.

    Arguments:
        vertices: (V, 3) metres; faces: (F, 3); edge: target edge length, metres.

    Returns:
        vertices (V', 3) f64, faces (F', 3) i32.

    Raises:
        BadData: nothing is left that could be simulated.
    """
    points, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32)
    if len(triangles) > _FEWEST_FACES:
        even, _ = remesh(Mesh(points.astype(np.float32), triangles), edge, close_holes=False)
        points, triangles = even.vertices.astype(np.float64), even.faces
    points, triangles = collapse_short_edges(points, triangles, SHORTEST_EDGE * edge)
    part = components(triangles, len(points))[triangles[:, 0]]
    sizes = np.bincount(part)
    large = sizes[part] >= _SMALLEST_PART * len(triangles)
    solid = face_normals(points, triangles)[1] > _SMALLEST_AREA
    triangles, used = keep_faces(triangles, large & solid, len(points))
    if not len(triangles):
        raise BadData(
            "Nothing of the garment can be simulated: no triangle has an area.",
            "simulation mesh",
            "Check the garment's layer with 'gw inspect'.",
        )
    return points[used], triangles


def collapse_short_edges(points: Doubles, faces: Indices, shortest: float) -> tuple[Doubles, Indices]:
    """Merge the ends of edges shorter than `shortest` metres, the shortest first, where that is safe.

    An end on the rim stays in place. An edge is left when its collapse would fold a face over or join two
    sheets (the link condition of Dey et al. 1999). Unused vertices remain.
    """
    refused: set[tuple[int, int]] = set()
    while True:
        collapsed = _collapse_pass(points, faces, shortest, refused)
        if len(collapsed) == len(faces):
            return points, faces
        faces = collapsed


def _collapse_pass(
    points: Doubles, faces: Indices, shortest: float, refused: set[tuple[int, int]]
) -> Indices:
    """Faces after one pass over the short edges; an edge beside another collapse waits for the next pass."""
    pairs = edges(faces)
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    order = np.argsort(lengths, kind="stable")
    rim = boundary_edges(faces)
    changed = np.zeros(len(points), dtype=bool)
    for a, b in pairs[order[: int((lengths < shortest).sum())]].tolist():
        around = faces[((faces == a) | (faces == b)).any(axis=1)]
        if (a, b) in refused or changed[around].any():
            continue
        collapsed = _collapsed(points, faces, a, b, rim)
        if collapsed is None:
            refused.add((a, b))
        else:
            changed[around] = True
            faces = collapsed
    return faces


def _collapsed(points: Doubles, faces: Indices, a: int, b: int, rim: Indices) -> Indices | None:
    """Faces after one end of the edge moved to the other, or None where that is not safe.

    Arguments:
        rim: (K, 2) boundary edges; up to date around the edge.
    """
    on_rim = np.isin([a, b], rim)
    edge_on_rim = bool(((rim == (a, b)) | (rim == (b, a))).all(axis=1).any())
    if on_rim.all() and not edge_on_rim:
        return None
    keep, drop = (b, a) if on_rim[1] and not on_rim[0] else (a, b)
    around_keep, around_drop = (faces == keep).any(axis=1), (faces == drop).any(axis=1)
    shared = around_keep & around_drop
    common = set(faces[around_keep].ravel()) & set(faces[around_drop].ravel()) - {keep, drop}
    if len(common) != int(shared.sum()) or len(faces) == int(shared.sum()):
        return None
    moved = np.where(faces == drop, keep, faces)
    before = face_normals(points, faces[around_drop & ~shared])[0]
    after, areas = face_normals(points, moved[around_drop & ~shared])
    if ((before * after).sum(axis=1) < 0.2).any() or (areas < _SMALLEST_AREA).any():
        return None
    return moved[~shared].astype(np.int32)

"""The constraints that hold a garment together, in an order that is safe to run side by side.

Constraints of one colour share no vertex. They are sorted by colour, so that a kernel may treat those of a
colour in any order, or at the same time, with the same result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from stages.shared.cloth.material import Material
from stages.shared.errors import BadData
from stages.shared.finite import require_finite
from stages.shared.meshes import boundary_edges, edges, face_normals

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]

MAX_VERTICES = 20_000
_SMALLEST_ANGLE_COTANGENT = 20.0  # of an angle of 2.9 degrees; slivers bend no stiffer than this


class Constraints(NamedTuple):
    """One garment as the kernels read it: a tuple of arrays.

    Attributes:
        inverse_mass: (V,) 1/kg; 0 for pinned vertices.
        faces: (F, 3).
        edges: (E, 2) vertex pairs; edge_rest: (E,) metres; edge_colors: (K+1,) first edge of every colour.
        bend_vertex: (B,) inner vertices; bend_start: (B+1,) rows of their neighbours in bend_ring.
        bend_ring: (R,) neighbours; bend_weight: (R,) cotangent weights, unitless.
        bend_rest: (B,) metres, the curvature that needs no force; bend_area: (B,) square metres.
        bend_colors: (L+1,) first bending constraint of every colour.
    """

    inverse_mass: Doubles
    faces: Indices
    edges: Indices
    edge_rest: Doubles
    edge_colors: Indices
    bend_vertex: Indices
    bend_start: Indices
    bend_ring: Indices
    bend_weight: Doubles
    bend_rest: Doubles
    bend_area: Doubles
    bend_colors: Indices


def build_constraints(
    vertices: NDArray, faces: NDArray, pinned: NDArray[np.bool_], material: Material
) -> Constraints:
    """Constraints of a garment that is at rest in the given shape.

    Arguments:
        vertices: (V, 3) metres, the template's pose.
        faces: (F, 3).
        pinned: (V,) vertices that follow the body.
        material: see Material; `balanced` is the caller's task (see `balance`).

    Raises:
        BadData: no faces, a face without area, more vertices than a simulation can take, NaN.
    """
    points = np.asarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    _check(points, faces, pinned)
    areas = vertex_areas(points, faces)
    mass = np.maximum(areas, 1e-9) * material.density
    inverse_mass = np.where(pinned | (areas <= 0.0), 0.0, 1.0 / mass)
    pairs, pair_colors = _ordered_edges(points, faces, pinned)
    bend_vertex, start, ring, weight = _bending_rings(points, faces)
    bend_vertex, start, ring, weight, bend_colors = _colored_rings(bend_vertex, start, ring, weight)
    rest = _curvature(points, faces, bend_vertex, start, ring, weight) * material.rest_curvature
    return Constraints(
        inverse_mass,
        faces,
        pairs,
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1),
        pair_colors,
        bend_vertex,
        start,
        ring,
        weight,
        rest,
        np.maximum(areas[bend_vertex], 1e-9),
        bend_colors,
    )


def vertex_areas(vertices: Doubles, faces: Indices) -> Doubles:
    """(V,) square metres: a third of the area of the faces around each vertex."""
    areas = face_normals(vertices, faces)[1] / 3.0
    total = np.zeros(len(vertices))
    for corner in range(3):
        total += np.bincount(faces[:, corner], areas, minlength=len(vertices))
    return total


def greedy_colors(members: list[NDArray[np.int64]], vertex_count: int) -> NDArray[np.int64]:
    """A colour for each constraint, so that two of a colour have no vertex in common.

    Arguments:
        members: vertices of each constraint; earlier ones get the lower colours.
    """
    used: list[set[int]] = [set() for _ in range(vertex_count)]
    colors = np.zeros(len(members), dtype=np.int64)
    for index, vertices in enumerate(members):
        taken = set().union(*(used[v] for v in vertices))
        color = next(c for c in range(len(taken) + 1) if c not in taken)
        colors[index] = color
        for v in vertices:
            used[v].add(color)
    return colors


def _check(points: Doubles, faces: Indices, pinned: NDArray[np.bool_]) -> None:
    require_finite("build_constraints", vertices=points)
    if len(points) > MAX_VERTICES:
        raise _bad(f"The garment has {len(points)} vertices; at most {MAX_VERTICES} can be simulated.")
    if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
        raise _bad("The garment's faces are missing or name vertices that do not exist.")
    if pinned.shape != (len(points),):
        raise _bad(f"There are {pinned.shape} pins for {len(points)} vertices.")
    empty = face_normals(points, faces)[1] < 1e-10
    if empty.any():
        raise _bad(f"Face {int(np.argmax(empty))} of the garment has no area.")


def _ordered_edges(points: Doubles, faces: Indices, pinned: NDArray[np.bool_]) -> tuple[Indices, Indices]:
    """Edges by colour, within a colour outward from the pins (from the top without pins)."""
    pairs = edges(faces)
    distance = _distance_from_support(points, pairs, pinned)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0], distance[pairs].min(axis=1)))]
    colors = greedy_colors([pair.astype(np.int64) for pair in pairs], len(points))
    order = np.argsort(colors, kind="stable")
    return np.ascontiguousarray(pairs[order], dtype=np.int32), _starts(colors)


def _distance_from_support(points: Doubles, pairs: Indices, pinned: NDArray[np.bool_]) -> Doubles:
    """(V,) metres along edges from the nearest pin; without pins, depth below the highest vertex."""
    below = points[:, 1].max() - points[:, 1]
    if not pinned.any():
        return below
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    graph = sparse.csr_array((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    distance = dijkstra(graph, directed=False, indices=np.flatnonzero(pinned), min_only=True)
    return np.where(np.isfinite(distance), distance, below)


def _bending_rings(points: Doubles, faces: Indices) -> tuple[Indices, Indices, Indices, Doubles]:
    """Inner vertices, and their neighbours with cotangent weights (half the sum of both cotangents)."""
    rows, columns, values = [], [], []
    for corner in range(3):
        i, j, k = faces[:, corner], faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
        u, v = points[j] - points[i], points[k] - points[i]
        cotangent = (u * v).sum(axis=1) / np.maximum(np.linalg.norm(np.cross(u, v), axis=1), 1e-12)
        half = 0.5 * np.clip(cotangent, -_SMALLEST_ANGLE_COTANGENT, _SMALLEST_ANGLE_COTANGENT)
        rows += [j, k]
        columns += [k, j]
        values += [half, half]
    matrix = sparse.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(points), len(points)),
    )
    matrix.sum_duplicates()
    matrix.sort_indices()
    matrix.data = np.maximum(matrix.data, 0.0)  # obtuse angles would pull neighbours the wrong way
    inner = np.ones(len(points), dtype=bool)
    inner[boundary_edges(faces).ravel()] = False
    inner &= np.diff(matrix.indptr) > 0
    vertex = np.flatnonzero(inner).astype(np.int32)
    counts = np.diff(matrix.indptr)[vertex]
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    slots = _runs(matrix.indptr[:-1][vertex], matrix.indptr[1:][vertex])
    return vertex, start, matrix.indices[slots].astype(np.int32), matrix.data[slots]


def _colored_rings(
    vertex: Indices, start: Indices, ring: Indices, weight: Doubles
) -> tuple[Indices, Indices, Indices, Doubles, Indices]:
    """The rings sorted by colour."""
    count = int(max(vertex.max(initial=-1), ring.max(initial=-1))) + 1
    members = [
        np.append(ring[start[b] : start[b + 1]], vertex[b]).astype(np.int64) for b in range(len(vertex))
    ]
    colors = greedy_colors(members, count)
    order = np.argsort(colors, kind="stable")
    slots = _runs(start[:-1][order], start[1:][order])
    new_start = np.concatenate([[0], np.cumsum(np.diff(start)[order])]).astype(np.int32)
    return vertex[order], new_start, ring[slots], weight[slots], _starts(colors)


def _curvature(
    points: Doubles, faces: Indices, vertex: Indices, start: Indices, ring: Indices, weight: Doubles
) -> Doubles:
    """(B,) metres: the cotangent Laplacian of every vertex along its normal."""
    normals = area_normals(points, faces)
    owner = np.repeat(vertex, np.diff(start))
    pull = weight[:, None] * (points[ring] - points[owner])
    rows = np.repeat(np.arange(len(vertex)), np.diff(start))
    along = (pull * normals[owner]).sum(axis=1)
    return np.asarray(np.bincount(rows, along, minlength=len(vertex)), dtype=np.float64)


def area_normals(points: Doubles, faces: Indices) -> Doubles:
    """(V, 3) unit vertex normals, weighted by area, f64."""
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(points)
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(faces[:, corner], normal[:, axis], minlength=len(points))
    return total / (np.linalg.norm(total, axis=1, keepdims=True) + 1e-20)


def _runs(first: NDArray, last: NDArray) -> NDArray[np.int64]:
    """The numbers of all ranges first..last, one range after the other."""
    runs = [np.arange(a, b, dtype=np.int64) for a, b in zip(first, last, strict=True)]
    return np.concatenate(runs) if runs else np.zeros(0, dtype=np.int64)


def _starts(colors: NDArray[np.int64]) -> Indices:
    counts = np.bincount(colors) if len(colors) else np.zeros(0, dtype=np.int64)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _bad(what: str) -> BadData:
    return BadData(what, "cloth simulation", "Check the garment's mesh.")

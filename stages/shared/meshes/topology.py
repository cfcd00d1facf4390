"""Normals, areas and neighbours of triangle meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stages.shared.finite import finite, require_finite

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


def face_normals(vertices: NDArray, faces: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit normals (F, 3) and areas (F,); a face without area has normal 0."""
    require_finite("face_normals", vertices=vertices)
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # Edges are brought near length one by a power of two, which rounds nothing, so that their products
    # neither vanish nor overflow.
    longest = np.maximum(np.abs(first), np.abs(second)).max(axis=1, initial=0.0)
    power = np.frexp(longest)[1]
    cross = np.cross(np.ldexp(first, -power[:, None]), np.ldexp(second, -power[:, None]))
    length = np.linalg.norm(cross, axis=1)
    areas = np.ldexp(length / 2, 2 * power)
    return cross / np.maximum(length, 1e-30)[:, None], finite(areas, "face_normals", vertices=vertices)


def vertex_normals(vertices: NDArray, faces: NDArray) -> Floats:
    """Unit normals (V, 3) f32, faces weighted by area; vertices without a face have normal 0."""
    normals, areas = face_normals(vertices, faces)
    sums = np.zeros((len(vertices), 3))
    for corner in range(3):
        for axis in range(3):
            sums[:, axis] += np.bincount(faces[:, corner], normals[:, axis] * areas, minlength=len(vertices))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 1e-20, sums / np.maximum(length, 1e-20), 0.0).astype(np.float32)


def edges(faces: NDArray) -> Ints:
    """Every edge once: (E, 2) i32 vertex indices, the smaller first, sorted."""
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0).astype(np.int32)


def boundary_edges(faces: NDArray) -> Ints:
    """Edges (E, 2) with one face only, in the direction of that face."""
    directed = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, inverse, counts = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    return directed[counts[inverse.reshape(-1)] == 1].astype(np.int32)


def adjacency(faces: NDArray, vertex_count: int) -> sparse.csr_array:
    """(V, V) sparse matrix, 1.0 where two vertices share an edge."""
    pairs = edges(faces)
    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0]])
    return sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(vertex_count, vertex_count))


def components(faces: NDArray, vertex_count: int) -> Ints:
    """(V,) number of the connected part each vertex belongs to."""
    _, labels = sparse.csgraph.connected_components(adjacency(faces, vertex_count), directed=False)
    return np.asarray(labels, dtype=np.int32)


def keep_faces(faces: NDArray, keep: NDArray[np.bool_], vertex_count: int) -> tuple[Ints, Ints]:
    """The chosen faces with vertices renumbered, and the old numbers (V',) of the vertices they use."""
    chosen = faces[keep]
    used = np.unique(chosen)
    renumbered = np.full(vertex_count, -1, np.int32)
    renumbered[used] = np.arange(len(used), dtype=np.int32)
    return renumbered[chosen], used.astype(np.int32)

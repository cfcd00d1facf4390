"""Cutting a labelled template into layer meshes that reach under their neighbours.

A scan is the outermost surface. Of a shirt under an open vest it shows only what the vest leaves uncovered.
The shirt continues under the vest, so it takes over the surface of the vest there, moved inward. No camera
sees this part while the vest is worn, and it prevents holes when the vest is taken off or swings open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from stages.shared.meshes.regions import mesh_edges


@dataclass(frozen=True)
class LayerPart:
    """One part of a mesh.

    Attributes:
        vertex_numbers: (V',) which vertices of the whole it has.
        faces: (F', 3) numbers into `vertex_numbers`.
        ring: (V',) 0 for own vertices, r for vertices added in the r-th ring under a neighbour.
    """

    vertex_numbers: np.ndarray
    faces: np.ndarray
    ring: np.ndarray


def extract_part(
    faces: np.ndarray,
    own: np.ndarray,
    allowed: np.ndarray,
    rings: int,
    vertex_count: int,
    beneath: np.ndarray | None = None,
) -> LayerPart:
    """The faces marked `own`, `rings` further rings of faces marked `allowed`, and those marked `beneath`.

    Arguments:
        faces: (F, 3). own, allowed, beneath: (F,) bool; what lies beneath counts as the last ring.
    """
    taken = own.copy()
    ring = np.full(vertex_count, -1)
    ring[faces[own]] = 0
    for number in range(1, rings + 1):
        grown = allowed & ~taken & (ring[faces] >= 0).any(axis=1)
        new = faces[grown].ravel()
        ring[new[ring[new] < 0]] = number
        taken |= grown
    if beneath is not None:
        new = faces[beneath & ~taken].ravel()
        ring[new[ring[new] < 0]] = max(rings, 1)
        taken |= beneath
    numbers = np.flatnonzero(ring >= 0)
    renumbered = np.full(vertex_count, -1)
    renumbered[numbers] = np.arange(len(numbers))
    return LayerPart(numbers, renumbered[faces[taken]], ring[numbers])


def faces_beneath(
    vertices: np.ndarray,
    faces: np.ndarray,
    own: np.ndarray,
    above: np.ndarray,
    reach: float,
    gap: float = 0.02,
) -> np.ndarray:
    """(F,) bool: faces marked `above` that lie within `reach` metres along the surface of faces marked `own`.

    Pieces of the mesh that are not connected touch where they come within `gap` metres of each other, as a
    vest lies on a shirt.

    Arguments:
        vertices: (V, 3) metres. faces: (F, 3). own, above: (F,) bool.
    """
    none = np.zeros(len(faces), dtype=bool)
    if reach <= 0 or not own.any() or not above.any():
        return none
    covered = np.unique(faces[above])
    distance, _ = cKDTree(vertices[np.unique(faces[own])]).query(vertices[covered], distance_upper_bound=gap)
    sources = covered[np.isfinite(distance)]
    if not len(sources):
        return none
    edges = mesh_edges(vertices, faces[above])
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) + 1e-9
    graph = sparse.coo_matrix((length, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2).tocsr()
    along = dijkstra(graph, directed=False, indices=sources, min_only=True, limit=reach)
    return above & np.isfinite(along)[faces].all(axis=1)


def sink(vertices: np.ndarray, normals: np.ndarray, ring: np.ndarray, depth: float) -> np.ndarray:
    """Move vertices (V, 3) of ring r inward by r · depth along their normals, under the neighbour."""
    return vertices - (ring * depth)[:, None] * normals


def join(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Several meshes with the same per-vertex arrays as one; `faces` are renumbered."""
    offsets = np.cumsum([0] + [len(part["vertices"]) for part in parts[:-1]])
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "faces"}
    joined["faces"] = np.concatenate(
        [part["faces"] + offset for part, offset in zip(parts, offsets, strict=True)]
    ).astype(np.int32)
    return joined

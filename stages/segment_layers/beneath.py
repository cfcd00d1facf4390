"""How far a garment goes on beneath another one, where no camera and no scan shows it.

A scan is the outermost surface: of a shirt under an open vest it holds what the vest leaves free. The shirt
goes on beneath, so it takes over the vest's surface there, moved inward, as far as is likely; what
lies there is never seen while the vest is worn, and keeps holes away when it is taken off or swings open.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from stages.segment_layers.regions import mesh_edges


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

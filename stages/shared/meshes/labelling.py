"""From votes of label images to one label per template vertex."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from stages.shared.layers import NO_LABEL
from stages.shared.meshes.graph_cut import alpha_expansion
from stages.shared.meshes.regions import drop_absent, mesh_edges, remove_islands, vertex_areas

_FLOOR = 0.02  # share of a vote that every label keeps: a vertex can be outvoted by its neighbourhood
_UNSEEN = 0.05  # how much the nearest seen vertex counts for one that no image sees


def label_costs(vertices: np.ndarray, edges: np.ndarray, votes: np.ndarray) -> np.ndarray:
    """(V, L) cost of each label: −log of its share of the votes, scaled by how well the vertex was seen.

    An unseen vertex leans faintly to the label of the seen vertex nearest along the surface (or, on a piece
    of the mesh that no camera sees, nearest in space).

    Arguments:
        vertices: (V, 3) metres. edges: (E, 2). votes: (V, L) ≥ 0, sums of view weights.
    """
    total = votes.sum(axis=1)
    seen = total > 1e-6
    if not seen.any():
        return np.zeros_like(votes, dtype=np.float64)
    share = np.full(votes.shape, 1.0 / votes.shape[1])
    share[seen] = votes[seen] / total[seen, None]
    trust = np.minimum(total / np.median(total[seen]), 1.0)
    if not seen.all():
        share[~seen] = share[nearest_seen(vertices, edges, seen)[~seen]]
        trust[~seen] = _UNSEEN
    floor = _FLOOR / votes.shape[1]
    return -np.log((1.0 - _FLOOR) * share + floor) * trust[:, None]


def nearest_seen(vertices: np.ndarray, edges: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(V,) number of the seen vertex nearest along the edges; where none can be reached, nearest in space."""
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = sparse.coo_matrix((length + 1e-9, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2).tocsr()
    sources = np.flatnonzero(seen)
    distance, _, nearest = dijkstra(
        graph, directed=False, indices=sources, min_only=True, return_predecessors=True
    )
    apart = ~np.isfinite(distance)
    if apart.any():
        nearest[apart] = sources[cKDTree(vertices[sources]).query(vertices[apart])[1]]
    return np.asarray(nearest)


def edge_weights(normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(E,) how much a label border across each of the edges (E, 2) costs: 1 on flat ground, less in creases.

    Arguments:
        normals: (V, 3) unit.
    """
    agreement = np.einsum("ek,ek->e", normals[edges[:, 0]], normals[edges[:, 1]])
    return 0.2 + 0.8 * np.clip(agreement, 0.0, 1.0) ** 4


def label_vertices(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    votes: np.ndarray,
    smoothness: float,
    sweeps: int,
) -> np.ndarray:
    """Labels (V,) of a template by a graph cut of the votes.

    Arguments:
        vertices: (V, 3) metres. faces: (F, 3). normals: (V, 3) unit. votes: (V, L) ≥ 0.
        smoothness: cost of a label border per edge on flat ground. sweeps: rounds over all labels.
    """
    edges = mesh_edges(vertices, faces)
    weights = smoothness * edge_weights(normals, edges)
    return alpha_expansion(label_costs(vertices, edges, votes), edges, weights, sweeps)


def tidy_labels(
    vertices: np.ndarray,
    faces: np.ndarray,
    labels: np.ndarray,
    garments: tuple[int, ...],
    smallest_island: float,
    smallest_share: float,
) -> np.ndarray:
    """Labels (V,) u8 without small patches and without garments that are hardly there.

    Arguments:
        smallest_island: m²; a smaller patch takes the label around it. smallest_share: of the whole area; a
            garment that covers less of it dissolves.
    """
    edges, areas = mesh_edges(vertices, faces), vertex_areas(vertices, faces)
    labels = remove_islands(np.asarray(labels, dtype=np.int64), edges, areas, smallest_island)
    return drop_absent(labels, edges, areas, garments, smallest_share).astype(np.uint8)


def known_labels(vertices: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels (V,) in which every vertex without one takes that of the nearest labelled vertex."""
    missing = labels == NO_LABEL
    if not missing.any():
        return labels
    _, nearest = cKDTree(vertices[~missing]).query(vertices[missing])
    labels = labels.copy()
    labels[missing] = labels[~missing][nearest]
    return labels

"""Labels of a surface: costs from votes, a smooth labelling by graph cuts, and tidying.

`alpha_expansion` (Boykov, Veksler, Zabih 2001) uses scipy's maximum flow. It minimises
Σ_v cost[v, label_v] + Σ_(u,v) weight_uv [label_u ≠ label_v]. Each expansion is the exact optimum of "every
vertex keeps its label or takes α"; the energy never rises.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow
from scipy.spatial import cKDTree

from stages.shared.layers import NO_LABEL
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


_UNITS = 1000.0  # capacities are integers: this many per unit of cost
_LARGEST = 1_000_000


def energy(labels: np.ndarray, costs: np.ndarray, edges: np.ndarray, weights: np.ndarray) -> float:
    """The minimised sum, for labels (V,), costs (V, L), edges (E, 2), weights (E,)."""
    unary = costs[np.arange(len(labels)), labels].sum()
    return float(unary + weights[labels[edges[:, 0]] != labels[edges[:, 1]]].sum())


def alpha_expansion(costs: np.ndarray, edges: np.ndarray, weights: np.ndarray, sweeps: int = 2) -> np.ndarray:
    """Labels (V,) from costs (V, L) ≥ 0, edges (E, 2) and weights (E,) ≥ 0.

    Starts from the cheapest label of every vertex; stops when a sweep over all labels changes nothing.
    """
    labels = costs.argmin(axis=1)
    for _ in range(sweeps):
        before = labels
        for alpha in range(costs.shape[1]):
            labels = expand(labels, alpha, costs, edges, weights)
        if (labels == before).all():
            break
    return labels


def expand(
    labels: np.ndarray, alpha: int, costs: np.ndarray, edges: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """The best labelling in which every vertex keeps its label or takes `alpha`.

    With x = 1 for taking α, an edge costs A = E(0,0), B = E(0,1), C = E(1,0), 0 = E(1,1), which is
    A + (C − A) x_u − C x_v + (B + C − A)(1 − x_u) x_v; the last factor is ≥ 0 here, so a cut can count it.
    """
    count = len(labels)
    vertices = np.arange(count)
    first, second = edges[:, 0], edges[:, 1]
    both_keep = weights * (labels[first] != labels[second])
    second_takes = weights * (labels[first] != alpha)
    first_takes = weights * (labels[second] != alpha)
    take = costs[:, alpha] - costs[vertices, labels]
    take = take + np.bincount(first, first_takes - both_keep, minlength=count)
    take -= np.bincount(second, first_takes, minlength=count)
    pairwise = second_takes + first_takes - both_keep
    side = _source_side(take, first, second, pairwise)
    return np.where(side, labels, alpha)


def _source_side(take: np.ndarray, first: np.ndarray, second: np.ndarray, pairwise: np.ndarray) -> np.ndarray:
    """(V,) bool: x = 0 in the minimum of Σ take·x + Σ pairwise (1 − x_first) x_second."""
    count = len(take)
    source, sink = count, count + 1
    rows = np.concatenate([np.full(count, source), np.arange(count), first])
    columns = np.concatenate([np.arange(count), np.full(count, sink), second])
    capacity = np.concatenate([np.maximum(take, 0.0), np.maximum(-take, 0.0), pairwise])
    capacity = np.minimum(np.rint(capacity * _UNITS), _LARGEST).astype(np.int32)
    open_edges = capacity > 0
    graph = sparse.csr_matrix(
        (capacity[open_edges], (rows[open_edges], columns[open_edges])), shape=(count + 2, count + 2)
    )
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    side = np.zeros(count + 2, dtype=bool)
    side[reached] = True
    return side[:count]

"""Smooth labelling of a graph: alpha expansion (Boykov, Veksler, Zabih 2001) over scipy's maximum flow.

Minimises Σ_v cost[v, label_v] + Σ_(u,v) weight_uv [label_u ≠ label_v]. Each expansion is the exact optimum of
"every vertex keeps its label or takes α"; the energy never rises.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

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

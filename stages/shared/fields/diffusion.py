"""Extension of values from a surface into space: inverse distance, averaging, distance-adaptive diffusion.

Inverse distance over the K nearest vertices is exact near the surface. On a dense mesh, the K neighbours
are one small patch, so the value still jumps between two legs. `diffuse_by_distance` avoids the jump. It
solves, on the grid, for the field that is close to the inverse-distance values near the skin and becomes
smoother with the distance from it. A skirt between the legs then follows both legs.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from stages.shared.finite import require_finite


def inverse_distance_matrix(
    tree: cKDTree, points: np.ndarray, neighbours: int = 30, clamp: float = 1e-4
) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Weights of the K nearest vertices, 1 / max(distance, clamp), rows summing to 1.

    Arguments:
        tree: of V vertices, metres.
        points: (N, 3) metres.

    Returns:
        matrix (N, V); distance (N,) to the nearest vertex; number (N,) of the nearest vertex.
    """
    require_finite("inverse_distance_matrix", points=points)
    neighbours = min(neighbours, tree.n)
    distance, number = tree.query(points, k=neighbours)
    distance, number = distance.reshape(len(points), -1), number.reshape(len(points), -1)
    weight = 1.0 / np.maximum(distance, clamp)
    weight /= weight.sum(axis=1, keepdims=True)
    starts = np.arange(0, weight.size + 1, neighbours)
    matrix = sparse.csr_matrix((weight.ravel(), number.ravel(), starts), shape=(len(points), tree.n))
    return matrix, distance[:, 0], number[:, 0]


def average_neighbours(values: np.ndarray, iterations: int, share: float = 0.3) -> np.ndarray:
    """f ← (1 − share)·f + share·mean of the 6 neighbours, at interior nodes of values (C, D, H, W).

    The smoothing of the paper's released field construction (30 iterations of share 0.3); how far it
    reaches depends on the pitch of the grid. Constants are kept exactly, sums over channels too.
    """
    values = values.copy()
    inner = (slice(None), slice(1, -1), slice(1, -1), slice(1, -1))
    for _ in range(iterations):
        mean = (
            values[:, 2:, 1:-1, 1:-1]
            + values[:, :-2, 1:-1, 1:-1]
            + values[:, 1:-1, 2:, 1:-1]
            + values[:, 1:-1, :-2, 1:-1]
            + values[:, 1:-1, 1:-1, 2:]
            + values[:, 1:-1, 1:-1, :-2]
        ) / 6.0
        values[inner] = (1.0 - share) * values[inner] + share * mean
    return values


def diffuse_by_distance(
    values: np.ndarray,
    lengths: np.ndarray,
    band: np.ndarray,
    pitch: np.ndarray,
    tolerance: float = 1e-4,
    iterations: int = 400,
) -> np.ndarray:
    """Smooth values over a band of grid nodes, each node over its own length.

    Solves (f − g)/ℓ² − Δf = 0 with natural boundaries: minimises Σ (f_i − f_j)²/h² + Σ (f_i − g_i)²/ℓ_i².
    The matrix is an M-matrix with unit row sums of its inverse times 1/ℓ², so every output is a convex
    combination of inputs: weights stay in [0, 1] and keep summing to 1.

    Arguments:
        values: (M, C) g, at the true nodes of band in raster order.
        lengths: (M,) ℓ, metres; small keeps the value, large smooths.
        band: (D, H, W) bool.
        pitch: (3,) spacing along x y z, metres.

    Returns:
        (M, C) float32.
    """
    keep = 1.0 / np.square(np.asarray(lengths, dtype=np.float64))
    matrix = (band_laplacian(band, pitch) + sparse.diags(keep)).tocsr()
    right = (keep[:, None] * values).astype(np.float32)
    return conjugate_gradient(matrix, right, values, tolerance, iterations)


def band_laplacian(band: np.ndarray, pitch: np.ndarray) -> sparse.csr_matrix:
    """Graph Laplacian (M, M) of 6-connected band nodes with edge weights 1/h² along each axis."""
    numbers = np.full(band.shape, -1, dtype=np.int64)
    numbers[band] = np.arange(np.count_nonzero(band))
    edges, weights = [], []
    for axis, step in zip((2, 1, 0), pitch, strict=True):
        low = np.moveaxis(numbers, axis, 0)[:-1].ravel()
        high = np.moveaxis(numbers, axis, 0)[1:].ravel()
        both = (low >= 0) & (high >= 0)
        edges.append(np.stack([low[both], high[both]], axis=1))
        weights.append(np.full(np.count_nonzero(both), 1.0 / step**2))
    return graph_laplacian(np.concatenate(edges), int(np.count_nonzero(band)), np.concatenate(weights))


def graph_laplacian(edges: np.ndarray, count: int, weights: np.ndarray | None = None) -> sparse.csr_matrix:
    """D − W (count, count) of undirected edges (E, 2), each listed once, with weights (E,), 1 by default.

    W holds the weights of the edges, D their sums at every node.
    """
    weights = np.ones(len(edges)) if weights is None else weights
    links = sparse.coo_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    links = links + links.T
    return (sparse.diags(np.asarray(links.sum(axis=1)).ravel()) - links).tocsr()


def conjugate_gradient(
    matrix: sparse.csr_matrix,
    right: np.ndarray,
    start: np.ndarray,
    tolerance: float = 1e-5,
    iterations: int = 400,
) -> np.ndarray:
    """Solve matrix · x = right (M, C) for all channels at once; matrix symmetric positive definite.

    Diagonal preconditioning; every channel has its own step lengths and leaves when it is done: when its
    residual has fallen below `tolerance` times the norm of the largest right-hand side. Works, and answers,
    in the type of `right`.
    """
    matrix = matrix.astype(right.dtype)
    inverse_diagonal = (1.0 / matrix.diagonal())[:, None]
    solution = np.array(start, dtype=right.dtype)
    channels = np.arange(solution.shape[1])
    current, residual = solution.copy(), right - matrix @ solution
    direction = inverse_diagonal * residual
    product = _column_products(residual, direction)
    limit = tolerance**2 * max(
        float(_column_products(right, inverse_diagonal * right).max(initial=0.0)), 1e-30
    )
    for _ in range(iterations):
        unfinished = product > limit
        if not unfinished.all():
            solution[:, channels[~unfinished]] = current[:, ~unfinished]
            channels, product = channels[unfinished], product[unfinished]
            current, residual, direction = (
                np.ascontiguousarray(part[:, unfinished]) for part in (current, residual, direction)
            )
        if not len(channels):
            break
        image = matrix @ direction
        step = product / np.maximum(_column_products(direction, image), 1e-30)
        current += step * direction
        residual -= step * image
        preconditioned = inverse_diagonal * residual
        following = _column_products(residual, preconditioned)
        direction *= following / np.maximum(product, 1e-30)
        direction += preconditioned
        product = following
    solution[:, channels] = current
    return solution


def _column_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("mc,mc->c", first, second)

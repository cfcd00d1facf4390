"""Rest lengths with which a garment hangs in balance in its template: no sag at the start.

Springs of stiffness k carry a tension T when they are T / k longer than at rest. The tensions are the
smallest ones that hold the weight of every free vertex together with pushes of the body on vertices that
touch it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import lsmr

from stages.shared.cloth.simulator import GRAVITY, Garment
from stages.shared.cloth.surface import Moving

Doubles = NDArray[np.float64]

_TOUCHING = 0.004  # metres beyond the margin at which the body still carries a vertex
_LARGEST_CHANGE = 0.15  # of a rest length
_ROUNDS = 4


def balanced_rest_lengths(garment: Garment, body: Moving | None) -> Doubles:
    """(E,) rest lengths of the edges of a garment's constraints, metres.

    Arguments:
        body: standing in the template's pose, or None where nothing carries the garment but its pins.
    """
    cloth, points = garment.constraints, garment.vertices
    vectors = points[cloth.edges[:, 0]] - points[cloth.edges[:, 1]]
    lengths = np.linalg.norm(vectors, axis=1)
    directions = vectors / lengths[:, None]
    free = cloth.inverse_mass > 0
    mass = np.where(free, 1.0 / np.where(free, cloth.inverse_mass, 1.0), 0.0)
    weight = (-mass[:, None] * np.array(GRAVITY)).ravel()
    edge = np.arange(len(lengths))
    columns = np.concatenate([edge, edge])
    rows = np.concatenate([cloth.edges[:, 1], cloth.edges[:, 0]])
    values = np.concatenate([directions, -directions])
    tension = _scatter(rows, columns, values, len(points), len(lengths))
    touching, normals = _contacts(garment, body)
    free_rows = np.repeat(free, 3)
    pushing = np.ones(len(touching), dtype=bool)
    for _ in range(_ROUNDS):  # the body pushes and never pulls
        push = _scatter(
            touching[pushing],
            np.arange(int(pushing.sum())),
            normals[pushing],
            len(points),
            int(pushing.sum()),
        )
        matrix = sparse.hstack([tension, push]).tocsr()[free_rows]
        solution = lsmr(matrix, weight[free_rows], damp=1e-3, maxiter=2000)[0]
        pulls = np.flatnonzero(pushing)[solution[len(lengths) :] < 0]
        if not len(pulls):
            break
        pushing[pulls] = False
    change = solution[: len(lengths)] / garment.material.edge_stiffness
    return np.clip(lengths - change, (1 - _LARGEST_CHANGE) * lengths, (1 + _LARGEST_CHANGE) * lengths)


def balanced(garment: Garment, body: Moving | None) -> Garment:
    """The garment with balanced rest lengths where its material asks for them."""
    from dataclasses import replace

    if not garment.material.balanced:
        return garment
    rest = balanced_rest_lengths(garment, body)
    return replace(garment, constraints=garment.constraints._replace(edge_rest=rest))


def _scatter(rows: NDArray, columns: NDArray, values: Doubles, points: int, count: int) -> sparse.csr_array:
    """(3 V, count) matrix with the vectors (K, 3) at (row, column)."""
    axis = np.tile(np.arange(3), len(rows))
    return sparse.csr_array(
        (values.ravel(), (np.repeat(rows, 3) * 3 + axis, np.repeat(columns, 3))), shape=(3 * points, count)
    )


def _contacts(garment: Garment, body: Moving | None) -> tuple[NDArray[np.int64], Doubles]:
    """Vertices that the body carries, and the normals (K, 3) there."""
    if body is None or not len(body.surface.faces):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    from scipy.spatial import cKDTree

    touchable = body.surface.touchable
    distance, nearest = cKDTree(body.before[touchable]).query(garment.vertices)
    near = distance < garment.skin_margin + _TOUCHING + 0.01
    normals = body.normals_before[touchable[nearest]]
    offset = ((garment.vertices - body.before[touchable[nearest]]) * normals).sum(axis=1)
    touching = np.flatnonzero(near & (offset < garment.skin_margin + _TOUCHING))
    return touching, normals[touching]

"""Cloth that was followed into the body, as linear equations that lead it out again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.avatar.deform import PosedGaussians

Floats = NDArray[np.float64]
_CLEARANCE = 0.004  # m between a garment's Gaussians and the body's
_REACH = 0.05  # m; cloth is not led through more of the body than this
_NEAREST = 4  # body texels that are averaged


def outwards(means: Tensor, body: PosedGaussians, carried: Floats, per_metre: float) -> tuple[Floats, Floats]:
    """Normal equations of one layer: texels nearer to the body than the clearance go out along its normal.

    Arguments:
        means: (N, 3) m, world. body: the body in the same pose. carried: (N, 3, 3) world from canonical
            directions. per_metre: unit of the solution, as in `Equations`.

    Returns:
        Matrix (N, 3, 3) and right side (N, 3); zero for texels that are free.
    """
    points = means.double().cpu().numpy()
    places, normals = (part.double().cpu().numpy() for part in (body.means, body.normals))
    distance, nearest = cKDTree(places).query(points, k=_NEAREST, distance_upper_bound=_REACH)
    found = np.isfinite(distance[:, -1])
    matrix, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    near = nearest[found]
    normal = normals[near].mean(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-9)
    height = np.einsum("nk,nk->n", points[found] - places[near].mean(axis=1), normal)
    # Neighbours whose normals disagree, as of two fingers, do not say where out is.
    wrong = (height < _CLEARANCE) & (length[:, 0] > 0.5)
    chosen = np.flatnonzero(found)[wrong]
    along = np.einsum("nk,nkl->nl", normal[wrong], carried[chosen])
    matrix[chosen] = along[:, :, None] * along[:, None, :]
    right[chosen] = ((_CLEARANCE - height[wrong]) * per_metre)[:, None] * along
    return matrix, right

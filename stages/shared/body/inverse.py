"""Linear blend skinning of points that each carry their own weights, and its exact inverse.

With M_j the transforms of the bones, a point x with weights w goes to (Σ_j w_j M_j) x; the inverse of
that same blend brings it back. Blending the inverses does not, where several bones share a point.
"""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.body.kinematics import blend
from stages.shared.finite import finite, require_finite

SMALLEST_DETERMINANT = 0.2


def forward_skin(points: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """(Σ_j w_j M_j) x for points (V, 3), weights (V, J), transforms (J, 4, 4) -> (V, 3)."""
    blended = _blend(weights, transforms)
    moved = np.einsum("vab,vb->va", blended[:, :3, :3], points) + blended[:, :3, 3]
    return finite(moved, "forward_skin", points=points, weights=weights, transforms=transforms)


def inverse_skin(
    world: np.ndarray, weights: np.ndarray, transforms: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(Σ_j w_j M_j)⁻¹ y; where |det| is small, Σ_j w_j M_j⁻¹ y instead.

    Returns:
        points (V, 3); replaced (V,) bool, where the second form was taken.

    Raises BadData, naming array and index, for numbers that are not finite.
    """
    require_finite("inverse_skin", world=world, weights=weights, transforms=transforms)
    blended = _blend(weights, transforms)
    linear, moved = blended[:, :3, :3], world - blended[:, :3, 3]
    replaced = np.abs(np.linalg.det(linear)) < SMALLEST_DETERMINANT
    points = np.empty_like(world)
    points[~replaced] = np.linalg.solve(linear[~replaced], moved[~replaced][..., None])[..., 0]
    if replaced.any():
        points[replaced] = forward_skin(world[replaced], weights[replaced], np.linalg.inv(transforms))
    return points, replaced


def _blend(weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    return blend(torch.from_numpy(weights), torch.from_numpy(transforms)).numpy()

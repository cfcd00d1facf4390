"""Inverse linear blend skinning: the canonical point and weights that pose to a world point, and torn faces.

With M_j the transform of bone j from the canonical pose to the world, a canonical point x with weights w
poses to (Σ_j w_j M_j) x. The inverse of that same blend, (Σ_j w_j M_j)⁻¹, brings the point back exactly;
blending the inverses does not where several bones share a point (armpits, elbows, crotch).

The weights are a function of the canonical point, w = W(x), so x is the root of (Σ_j W_j(x) M_j) x = y.
The search starts with weights of the posed body and takes damped fixed-point steps, then Newton steps. The
returned pair (x, w) satisfies the equation with w held fixed, whatever residual is left in w = W(x).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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


Weights = Callable[[np.ndarray], np.ndarray]  # canonical points (N, 3) -> weights (N, J)


@dataclass(frozen=True)
class Unposed:
    """Canonical points with the weights that pose them.

    Attributes:
        points: (V, 3) metres, canonical.
        weights: (V, J).
        residual: (V,) metres, distance of the reposed point with the kept weights.
        requeried_residual: (V,) metres, the same with the weights that the field has at the canonical point.
        blended_inverse: number of points where the blend was too close to singular to be inverted.
    """

    points: np.ndarray
    weights: np.ndarray
    residual: np.ndarray
    requeried_residual: np.ndarray
    blended_inverse: int


def unpose(
    world: np.ndarray,
    start_weights: np.ndarray,
    transforms: np.ndarray,
    weights_at: Weights,
    fixed_point_steps: int = 8,
    newton_steps: int = 6,
    damping: float = 0.7,
) -> Unposed:
    """Bring world points to the canonical pose.

    Arguments:
        world: (V, 3) metres.
        start_weights: (V, J) from the posed body.
        transforms: (J, 4, 4) posed_from_canonical.
        weights_at: the canonical weight field.

    Returns:
        see `Unposed`. Where the root is not found the best pair seen is kept.
    """
    best_weights = start_weights
    best_points, _ = inverse_skin(world, start_weights, transforms)
    best_error = _requery_error(best_points, world, transforms, weights_at)
    weights = start_weights
    for _ in range(fixed_point_steps):
        points, _ = inverse_skin(world, weights, transforms)
        weights = (1.0 - damping) * weights + damping * weights_at(points)
        points, _ = inverse_skin(world, weights, transforms)
        best_points, best_error = _keep_better(
            best_points, best_error, points, _requery_error(points, world, transforms, weights_at)
        )
    for _ in range(newton_steps):
        open_rows = np.flatnonzero(best_error > 1e-6)
        if not len(open_rows):
            break
        points = _newton_step(best_points[open_rows], world[open_rows], transforms, weights_at)
        error = _requery_error(points, world[open_rows], transforms, weights_at)
        best_points[open_rows], best_error[open_rows] = _keep_better(
            best_points[open_rows], best_error[open_rows], points, error
        )
    # The field's own weights at the root; one exact inverse with them makes the pair consistent.
    best_weights = weights_at(best_points)
    points, replaced = inverse_skin(world, best_weights, transforms)
    residual = np.linalg.norm(forward_skin(points, best_weights, transforms) - world, axis=1)
    requeried = _requery_error(points, world, transforms, weights_at)
    return Unposed(points, best_weights, residual, requeried, int(np.count_nonzero(replaced)))


def _requery_error(
    points: np.ndarray, world: np.ndarray, transforms: np.ndarray, weights_at: Weights
) -> np.ndarray:
    return np.linalg.norm(forward_skin(points, weights_at(points), transforms) - world, axis=1)


def _keep_better(
    points: np.ndarray, error: np.ndarray, other_points: np.ndarray, other_error: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    better = other_error < error
    return np.where(better[:, None], other_points, points), np.where(better, other_error, error)


def _newton_step(
    points: np.ndarray, world: np.ndarray, transforms: np.ndarray, weights_at: Weights, step: float = 2e-3
) -> np.ndarray:
    """One Newton step on x ↦ (Σ_j W_j(x) M_j) x − y; Jacobian by central differences over `step` metres."""
    residual = forward_skin(points, weights_at(points), transforms) - world
    jacobian = np.empty((len(points), 3, 3))
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        ahead = forward_skin(points + shift, weights_at(points + shift), transforms)
        behind = forward_skin(points - shift, weights_at(points - shift), transforms)
        jacobian[:, :, axis] = (ahead - behind) / (2.0 * step)
    singular = np.abs(np.linalg.det(jacobian)) < 0.05
    jacobian[singular] = np.eye(3)
    return points - np.linalg.solve(jacobian, residual[..., None])[..., 0]


@dataclass(frozen=True)
class Tears:
    """Edges that grew too much.

    Attributes:
        faces: (F',3) the faces that are left.
        torn_edges: how many edges grew by more than the limit.
        cut_faces: how many faces were taken away with them.
        largest_growth: of all edges longer than the noise limit afterwards.
    """

    faces: np.ndarray
    torn_edges: int
    cut_faces: int
    largest_growth: float


def cut_tears(
    faces: np.ndarray, before: np.ndarray, after: np.ndarray, growth: float, shortest: float
) -> Tears:
    """Drop faces with an edge that is `growth` times longer `after` than `before` and longer than `shortest`.

    Arguments:
        faces: (F, 3). before, after: (V, 3) metres.
    """
    factor = edge_growth(faces, before, after, shortest)
    torn = factor > growth
    edges = np.sort(np.stack((faces, np.roll(faces, -1, axis=1)), axis=2)[torn], axis=1)
    intact = faces[~torn.any(axis=1)]
    return Tears(
        intact, len(np.unique(edges, axis=0)), len(faces) - len(intact), float(factor.max(initial=0.0))
    )


def edge_growth(faces: np.ndarray, before: np.ndarray, after: np.ndarray, shortest: float) -> np.ndarray:
    """(F, 3) length of each edge `after` over `before`; 1 where it is not longer than `shortest` metres."""
    ends = faces, np.roll(faces, -1, axis=1)
    length_before = np.linalg.norm(before[ends[0]] - before[ends[1]], axis=2)
    length_after = np.linalg.norm(after[ends[0]] - after[ends[1]], axis=2)
    return np.where(length_after > shortest, length_after / np.maximum(length_before, 1e-6), 1.0)

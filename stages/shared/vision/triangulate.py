"""Landmarks of several calibrated views as points in the world, with what the views disagree about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera

Doubles = NDArray[np.float64]

# BlazePose's pairs of left and right; networks confuse them when somebody is seen from behind.
SIDES = tuple((left, left + 1) for left in (7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31)) + (
    (1, 4),
    (2, 5),
    (3, 6),
)
_MOST_ERROR = 0.05  # of the distance to the camera: a view that is off by more is wrong
_ROUNDS = (0.08, 0.04, 0.02, 0.02)  # robust distance, of the distance to the camera
_LEAST_VISIBILITY = 0.2
_SWAPPED_BETTER = 0.6


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Landmarks in the world.

    Attributes:
        points: (T, L, 3) f64 metres; NaN where fewer than two views agree.
        views: (T, L) how many views agree.
        pixels: (C, T, L) f64 reprojection error; NaN where the view does not show the landmark.
        swapped: (C, T) whether left and right were exchanged in a view.
    """

    points: Doubles
    views: NDArray[np.int32]
    pixels: Doubles
    swapped: NDArray[np.bool_]


def triangulate(cameras: Sequence[Camera], pixels: Doubles, visibility: Doubles) -> Triangulated:
    """The points that most views agree on.

    Each point is the one nearest to the rays of all views (weighted least squares), found again with weights
    that fall with its distance from each ray (Geman-McClure). Left and right are exchanged in views that then
    agree better with the others.

    Arguments:
        pixels: (C, T, L, 2), NaN where nothing was found. visibility: (C, T, L) in [0, 1].
    """
    places, swapped = exchange_sides(cameras, pixels, visibility)
    weights = np.where(np.isfinite(places[..., 0]), visibility, 0.0)
    weights = np.where(weights < _LEAST_VISIBILITY, 0.0, weights)
    origins, rays = _rays(cameras, places)
    points, share = _nearest_points(origins, rays, weights)
    views = ((share < _MOST_ERROR) & (weights > 0)).sum(axis=0).astype(np.int32)
    points = np.where((views >= 2)[..., None], points, np.nan)
    return Triangulated(points, views, reprojection_errors(cameras, points, places), swapped)


def exchange_sides(
    cameras: Sequence[Camera], pixels: Doubles, visibility: Doubles
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Pixels with left and right exchanged where views then agree better, and where that is (C, T)."""
    order = np.arange(pixels.shape[2])
    for left, right in SIDES:
        if right < len(order):
            order[left], order[right] = right, left
    swapped = np.zeros(pixels.shape[:2], bool)
    places = pixels.copy()
    for _ in range(3):
        weights = np.where(np.isfinite(places[..., 0]), np.maximum(visibility, 1e-3), 0.0)
        origins, rays = _rays(cameras, places)
        points, _ = _nearest_points(origins, rays, weights)
        straight = _view_error(cameras, points, places)
        crossed = _view_error(cameras, points, places[:, :, order])
        change = crossed < _SWAPPED_BETTER * straight
        if not change.any():
            break
        places = np.where(change[..., None, None], places[:, :, order], places)
        swapped ^= change
    return places, swapped


def reprojection_errors(cameras: Sequence[Camera], points: Doubles, pixels: Doubles) -> Doubles:
    """(C, T, L) pixels between landmarks and projected points; NaN where either is missing."""
    known = np.asarray(np.isfinite(points).all(axis=-1))
    filled = np.where(known[..., None], points, 0.0)
    errors = []
    for camera, places in zip(cameras, pixels, strict=True):
        away = np.linalg.norm(camera.project(filled)[0] - places, axis=-1)
        errors.append(np.where(known, away, np.nan))
    return np.stack(errors)


def _view_error(cameras: Sequence[Camera], points: Doubles, pixels: Doubles) -> Doubles:
    """(C, T) median reprojection error of each view; infinity where nothing is known."""
    errors = reprojection_errors(cameras, points, pixels)
    missing = np.asarray(~np.isfinite(errors).any(axis=-1))
    return np.where(missing, np.inf, np.nanmedian(np.where(missing[..., None], 0.0, errors), axis=-1))


def _rays(cameras: Sequence[Camera], pixels: Doubles) -> tuple[Doubles, Doubles]:
    """Origins (C, 3) and unit directions (C, T, L, 3) of the landmarks' rays, world; NaN stays NaN."""
    directions = []
    for camera, places in zip(cameras, pixels, strict=True):
        homogeneous = np.concatenate([places, np.ones_like(places[..., :1])], axis=-1)
        way = homogeneous @ np.linalg.inv(camera.intrinsics).T @ camera.camera_from_world[:3, :3]
        directions.append(way / np.linalg.norm(way, axis=-1, keepdims=True))
    return np.stack([camera.centre for camera in cameras]), np.stack(directions)


def _nearest_points(origins: Doubles, rays: Doubles, weights: Doubles) -> tuple[Doubles, Doubles]:
    """Points (T, L, 3) nearest to the rays, and the sine of the angle to each ray (C, T, L)."""
    rays = np.nan_to_num(rays)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]  # (C, T, L, 3, 3)
    onto = np.einsum("ctlij,cj->ctli", across, origins)
    current, share = weights, np.zeros(weights.shape)
    points = np.zeros((*weights.shape[1:], 3))
    for robust in (np.inf, *_ROUNDS):
        if np.isfinite(robust):
            current = weights * (robust**2 / (robust**2 + share**2)) ** 2
        matrix = np.einsum("ctl,ctlij->tlij", current, across) + 1e-9 * np.eye(3)
        right = np.einsum("ctl,ctli->tli", current, onto)
        points = np.linalg.solve(matrix, right[..., None])[..., 0]
        way = points - origins[:, None, None]
        away = np.linalg.norm(np.einsum("ctlij,ctlj->ctli", across, way), axis=-1)
        share = away / np.maximum(np.linalg.norm(way, axis=-1), 1e-9)
    return points, share

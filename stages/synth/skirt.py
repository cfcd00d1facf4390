"""A flared skirt: rings from the waist to the knee, following the hips, then widening, with soft ripples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import JOINT_INDEX
from stages.synth.bodies import ShapedBody
from stages.synth.fitted_garments import Cut
from stages.synth.offset_surface import DistanceGrid

WAIST_EASE = 0.008
FLARE = 0.42  # metres of radius per metre below the hips
RIPPLES = 9


def flared_skirt(mean: ShapedBody, spacing: float, repeat: float, phase: float) -> Cut:
    """The skirt's cut.

    Arguments:
        spacing: of the rings, metres; columns are spaced so at the hip.
        repeat: period of the fabric; a whole number of periods goes around, so that there is no seam.
        phase: of the ripples, radians.
    """
    pelvis, knee = mean.joints[JOINT_INDEX["pelvis"]], mean.joints[JOINT_INDEX["left_knee"]]
    top, bottom = pelvis[1] + 0.085, knee[1] + 0.03
    hip_line = pelvis[1] - 0.10
    rings = int(np.ceil((top - bottom) * 1.08 / spacing)) + 1
    columns = int(np.ceil(1.15 / spacing))
    heights = np.linspace(top, bottom, rings)
    angles = 2 * np.pi * np.arange(columns) / columns
    middle = np.array([0.0, 0.0, pelvis[2] + 0.005])
    radius = _fitted_radius(mean, heights, angles, middle, spacing)  # (rings, columns)
    hip = int(np.abs(heights - hip_line).argmin())
    below = np.maximum(hip_line - heights, 0.0)[:, None]
    radius[hip:] = radius[hip]
    amplitude = 0.075 * below
    radius = radius + FLARE * below + amplitude * np.cos(RIPPLES * angles + phase)
    x, z = radius * np.sin(angles), radius * np.cos(angles)
    y = np.broadcast_to(heights[:, None], x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) + middle

    around = repeat * np.round(2 * np.pi * radius[hip].mean() * 1.25 / repeat)
    u = around * np.arange(columns + 1) / columns
    down = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(heights), np.diff(radius.mean(axis=1))))])
    faces, corner_uv = _tube(rings, columns, u, -down)
    pinned = np.arange(rings * columns) < columns  # the waist
    return Cut(vertices, faces, corner_uv, pinned)


def _fitted_radius(
    mean: ShapedBody,
    heights: NDArray[np.float64],
    angles: NDArray[np.float64],
    middle: NDArray[np.float64],
    spacing: float,
) -> NDArray[np.float64]:
    """(rings, columns) smallest radius that stays WAIST_EASE off the body and never narrows downwards."""
    lower = np.array([-0.34, heights.min() - 0.02, -0.32])
    upper = np.array([0.34, heights.max() + 0.02, 0.34])
    grid = DistanceGrid(mean.rest_vertices, mean.faces, lower, upper, min(spacing, 0.017), blur=0.5)
    steps = np.linspace(0.30, 0.05, 126)
    direction = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=-1)
    centres = middle + heights[:, None] * np.array([0.0, 1.0, 0.0])
    points = centres[:, None, None] + steps[:, None] * direction[:, None]  # (rings, columns, steps, 3)
    near = grid.at(points.reshape(-1, 3)).reshape(points.shape[:3]) < WAIST_EASE
    first = np.where(near.any(axis=-1), near.argmax(axis=-1), len(steps) - 1)
    radius = np.maximum.accumulate(steps[first], axis=0)
    for _ in range(3):  # smooth around the ring
        radius = 0.5 * radius + 0.25 * (np.roll(radius, 1, axis=1) + np.roll(radius, -1, axis=1))
    return radius


def _tube(
    rings: int, columns: int, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Faces (F, 3) of a tube with alternating diagonals and their corner_uv (F, 3, 2)."""
    ring = np.repeat(np.arange(rings - 1), columns)
    column = np.tile(np.arange(columns), rings - 1)
    corner_rings = np.stack([ring, ring + 1, ring + 1, ring], axis=1)
    corner_columns = np.stack([column, column, column + 1, column + 1], axis=1)
    index = corner_rings * columns + corner_columns % columns
    uv = np.stack([u[corner_columns], v[corner_rings]], axis=-1)  # (Q, 4, 2)
    even = (ring + column) % 2 == 0
    halves = [(even, (0, 1, 2)), (even, (0, 2, 3)), (~even, (0, 1, 3)), (~even, (1, 2, 3))]
    faces = np.concatenate([index[chosen][:, list(three)] for chosen, three in halves])
    corner_uv = np.concatenate([uv[chosen][:, list(three)] for chosen, three in halves])
    return faces, corner_uv

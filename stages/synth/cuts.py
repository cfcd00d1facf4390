"""What a person wears as geometry around the mean body: T-shirt, vest, trousers, skirt, hair and shoes.

Most are offset surfaces of the body. The skirt is a flared cone from the waist to the knee.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import JOINT_INDEX
from stages.synth.bodies import ShapedBody
from stages.synth.offset_surface import DistanceGrid, shell

Doubles = NDArray[np.float64]

WAIST_EASE = 0.008
FLARE = 0.42  # metres of radius per metre below the hips
RIPPLES = 9


@dataclass(frozen=True, eq=False)
class Cut:
    """A garment's cut around the mean body in its rest pose.

    Attributes:
        vertices: (V, 3) f64 metres.
        faces: (F, 3) i64.
        corner_uv: (F, 3, 2) f64 metres.
        pinned: (V,) vertices that move with the bones.
    """

    vertices: Doubles
    faces: NDArray[np.int64]
    corner_uv: Doubles
    pinned: NDArray[np.bool_]


def t_shirt(mean: ShapedBody, spacing: float) -> Cut:
    """Short sleeves, round neck, hem below the hips' top."""
    shoulder, elbow, neck = _joint(mean, "left_shoulder"), _joint(mean, "left_elbow"), _joint(mean, "neck")
    hem = _joint(mean, "pelvis")[1] - 0.055
    sleeve = shoulder[0] + 0.52 * (elbow[0] - shoulder[0])
    throat = neck + np.array([0.0, 0.02, 0.035])

    def offset(points: Doubles) -> Doubles:
        down = np.clip((shoulder[1] - points[:, 1]) / (shoulder[1] - hem), 0.0, 1.0)
        out = np.clip((np.abs(points[:, 0]) - shoulder[0]) / (sleeve - shoulder[0]), 0.0, 1.0)
        return 0.011 + 0.016 * down + 0.008 * out

    def outside(points: Doubles) -> Doubles:
        opening = 0.092 - np.linalg.norm((points - throat) * (1.0, 0.85, 1.0), axis=1)
        return np.maximum.reduce([np.abs(points[:, 0]) - sleeve, hem - points[:, 1], opening])

    grid = _grid(mean, (-sleeve - 0.05, hem - 0.05, -0.32), (sleeve + 0.05, neck[1] + 0.16, 0.34), spacing)
    vertices, faces = shell(grid, offset, outside)
    pinned = np.zeros(len(vertices), dtype=bool)  # it hangs from the shoulders
    return Cut(vertices, faces, _torso_uv(vertices, faces, mean, shoulder[0] - 0.012), pinned)


def open_vest(mean: ShapedBody, spacing: float) -> Cut:
    """No sleeves, open in front, a little longer than the waist."""
    shoulder, neck = _joint(mean, "left_shoulder"), _joint(mean, "neck")
    hem = _joint(mean, "pelvis")[1] - 0.01
    throat = neck + np.array([0.0, 0.02, 0.04])

    def offset(points: Doubles) -> Doubles:
        down = np.clip((shoulder[1] - points[:, 1]) / (shoulder[1] - hem), 0.0, 1.0)
        return 0.024 + 0.022 * down

    def outside(points: Doubles) -> Doubles:
        side = np.abs(points[:, 0])
        neckline = 0.108 - np.linalg.norm((points - throat) * (1.0, 0.85, 1.0), axis=1)
        gap = 0.045 + 0.05 * np.clip((points[:, 1] - hem) / (shoulder[1] - hem), 0.0, 1.0)
        front = np.where(points[:, 2] > throat[2] - 0.04, gap - side, -1.0)
        # The arm hole: a slanted plane that leaves the top of the shoulder covered, and ends under the arm.
        slope = np.clip(points[:, 1] - shoulder[1] + 0.02, -0.2, 0.1)
        under_arm = np.maximum(shoulder[1] - 0.19 - points[:, 1], 0.0)
        arm = side - (shoulder[0] - 0.012 - 0.10 * slope + 1.5 * under_arm)
        return np.maximum.reduce([hem - points[:, 1], neckline, front, arm])

    wide = shoulder[0] + 0.14
    grid = _grid(mean, (-wide, hem - 0.06, -0.34), (wide, neck[1] + 0.16, 0.36), spacing)
    vertices, faces = shell(grid, offset, outside)
    near_neck = np.linalg.norm((vertices - throat) * (1.0, 0.85, 1.0), axis=1)
    pinned = (near_neck < 0.12) & (vertices[:, 2] < neck[2])  # the back of the collar
    return Cut(vertices, faces, _torso_uv(vertices, faces, mean, np.inf), pinned)


def trousers(mean: ShapedBody, spacing: float) -> Cut:
    """Straight legs from the waist to above the ankle."""
    pelvis, hip, ankle = _joint(mean, "pelvis"), _joint(mean, "left_hip"), _joint(mean, "left_ankle")
    top, bottom = pelvis[1] + 0.075, ankle[1] + 0.055

    def offset(points: Doubles) -> Doubles:
        down = np.clip((hip[1] - points[:, 1]) / (hip[1] - bottom), 0.0, 1.0)
        return 0.009 + 0.020 * np.minimum(down * 2.0, 1.0)

    def outside(points: Doubles) -> Doubles:
        return np.maximum.reduce([points[:, 1] - top, bottom - points[:, 1], np.abs(points[:, 0]) - 0.42])

    grid = _grid(mean, (-0.42, bottom - 0.05, -0.28), (0.42, top + 0.05, 0.32), spacing)
    vertices, faces = shell(grid, offset, outside)
    pinned = vertices[:, 1] > top - 0.015
    return Cut(vertices, faces, _leg_uv(vertices, faces, mean), pinned)


def flared_skirt(mean: ShapedBody, spacing: float, repeat: float, phase: float) -> Cut:
    """Rings from the waist to the knee: close around the hips, then wider and wider, with soft ripples.

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


def hair_cap(mean: ShapedBody, spacing: float, length: float) -> tuple[Doubles, NDArray[np.int64]]:
    """Hair as a cap; `length` metres below the ears at the back (negative: shorter)."""
    head, crown = _joint(mean, "head"), mean.rest_vertices[:, 1].max()
    ear = head[1] + 0.42 * (crown - head[1])
    brow = head[1] + 0.74 * (crown - head[1])

    def offset(points: Doubles) -> Doubles:
        return np.full(len(points), 0.013)

    def outside(points: Doubles) -> Doubles:
        forward = np.clip((points[:, 2] - head[2] - 0.005) / 0.05, 0.0, 1.0)
        limit = ear - length + forward * (brow - ear + length)
        return limit - points[:, 1]

    grid = _grid(mean, (-0.16, ear - length - 0.06, -0.2), (0.16, crown + 0.06, 0.3), spacing)
    return shell(grid, offset, outside)


def shoe(mean: ShapedBody, spacing: float, side: int) -> tuple[Doubles, NDArray[np.int64]]:
    """One shoe: 9 mm off the foot, toes bridged, thicker below; side +1 left, −1 right."""
    ankle = _joint(mean, "left_ankle" if side > 0 else "right_ankle")
    sole = mean.rest_vertices[:, 1].min()

    def offset(points: Doubles) -> Doubles:
        return 0.009 + 0.010 * np.clip((sole + 0.03 - points[:, 1]) / 0.03, 0.0, 1.0)

    def outside(points: Doubles) -> Doubles:
        return np.maximum(points[:, 1] - ankle[1] - 0.012, 0.03 - side * points[:, 0])

    low = np.array([ankle[0] - 0.14, sole - 0.05, -0.24])
    high = np.array([ankle[0] + 0.14, ankle[1] + 0.05, 0.32])
    return shell(_grid(mean, tuple(low), tuple(high), spacing, blur=0.7), offset, outside)


def _joint(mean: ShapedBody, name: str) -> Doubles:
    return mean.joints[JOINT_INDEX[name]]


def _grid(
    mean: ShapedBody,
    lower: tuple[float, ...],
    upper: tuple[float, ...],
    spacing: float,
    blur: float = 0.8,
) -> DistanceGrid:
    return DistanceGrid(mean.rest_vertices, mean.faces, np.array(lower), np.array(upper), spacing, blur)


def _torso_uv(vertices: Doubles, faces: NDArray[np.int64], mean: ShapedBody, sleeve_from: float) -> Doubles:
    """(F, 3, 2) u around the torso from the front, v up; on sleeves u around the arm, v outwards."""
    corners = vertices[faces]
    axis = np.array([0.0, 0.0, _joint(mean, "spine2")[2] + 0.01])
    u = _around(
        corners[..., 0] - axis[0], corners[..., 2] - axis[2], vertices[:, 0], vertices[:, 2] - axis[2]
    )
    uv = np.stack([u, corners[..., 1]], axis=-1)
    shoulder = _joint(mean, "left_shoulder")
    centre = corners.mean(axis=1)
    sleeve = (np.abs(centre[:, 0]) > sleeve_from) & (centre[:, 1] > shoulder[1] - 0.13)
    if sleeve.any():
        arm = corners[sleeve]
        above, front = arm[..., 1] - shoulder[1], arm[..., 2] - shoulder[2]
        angle = _unwrapped(np.arctan2(front, above))
        uv[sleeve] = np.stack([0.062 * angle, 1.0 + np.abs(arm[..., 0])], axis=-1)
    return uv


def _leg_uv(vertices: Doubles, faces: NDArray[np.int64], mean: ShapedBody) -> Doubles:
    """(F, 3, 2) u around the leg (each half of the seat belongs to its leg), v up."""
    corners = vertices[faces]
    side = np.where(corners[..., 0].mean(axis=1) >= 0, 1.0, -1.0)[:, None]
    hip, ankle = _joint(mean, "left_hip"), _joint(mean, "left_ankle")
    down = np.clip((hip[1] - corners[..., 1]) / (hip[1] - ankle[1]), 0.0, 1.0)
    across = side * corners[..., 0] - (0.075 + down * (ankle[0] - 0.075))
    front = corners[..., 2] - (0.02 + down * (ankle[2] - 0.02))
    angle = _unwrapped(np.arctan2(across, front))
    return np.stack([side * 0.098 * angle, corners[..., 1]], axis=-1)


def _around(x: Doubles, z: Doubles, all_x: Doubles, all_z: Doubles) -> Doubles:
    """Arc length along the mean outline, by angle from the front (+z); continuous within a triangle."""
    bins = np.linspace(-np.pi, np.pi, 49)
    angle_all = np.arctan2(all_x, all_z)
    torso = np.abs(all_x) < 0.2
    radius_all = np.hypot(all_x, all_z)
    centre = 0.5 * (bins[1:] + bins[:-1])
    which = np.clip(np.digitize(angle_all, bins) - 1, 0, len(centre) - 1)
    radius = np.array([_median(radius_all[torso & (which == b)]) for b in range(len(centre))])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(radius, np.gradient(radius, centre)) * np.diff(bins))])
    arc -= np.interp(0.0, bins, arc)
    angle = _unwrapped(np.arctan2(x, z))
    turns = np.round(angle / (2 * np.pi))
    return np.interp(angle - 2 * np.pi * turns, bins, arc) + turns * (arc[-1] - arc[0])


def _median(values: Doubles) -> float:
    return float(np.median(values)) if len(values) else 0.14


def _unwrapped(angle: Doubles) -> Doubles:
    """(F, 3) angles of a triangle's corners without a jump of 2π between them."""
    return angle[:, :1] + (angle - angle[:, :1] + np.pi) % (2 * np.pi) - np.pi


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

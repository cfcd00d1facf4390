"""Body Gaussians that nobody can see beneath opaque garments: they need not be posed or drawn.

A body texel is hidden when it lies deep beneath a garment (`covered_weights` is 1), when in some poses of the
motion and from all around, above and below it adds next to nothing to any picture, and when the same holds
for all texels within a margin of it. What a Gaussian adds to a picture is the sum of its blending weights:
the derivative of the summed picture by the Gaussian's own feature, against the area of its image.

Whoever takes a garment off makes another outfit, with a plan of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body import Poses, posed_joints
from stages.shared.body.posed import pose_tensors
from stages.shared.capture.camera import Camera
from stages.shared.layers import BODY
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.coverage import covered_weights, same_grid
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.splat.api import contributions as splat_contributions
from stages.shared.splat.gaussians import Gaussians

LEAST_CONTRIBUTION = (
    0.0013  # of what a Gaussian would add with nothing before it: a third of one of 255 levels
)
MARGIN = 0.013  # m around what is seen that is drawn as well
MOST_POSES = 12
LEAST_PICTURES = 300
"""A film of fewer is made sooner than the plan."""
_BLUR = 0.3  # px², of the splatter
_SIDE = 256  # px of the pictures in which texels are looked for
_REACH = 0.25  # m around the joints
_AROUND = ((0.08, 5, 0.0), (-0.7, 3, 0.5), (1.2, 2, 0.9))  # tilt, how many, azimuth of the first


def find_hidden_texels(outfit: Outfit, poses: Poses, rows: Sequence[int]) -> NDArray[np.bool_] | None:
    """(N,) which texels of the body need not be drawn in a motion; None where all must be.

    Arguments:
        poses: the motion. rows: of it, those that will be played; `MOST_POSES` of them are looked at.
    """
    covered = fully_covered(outfit)
    if not covered.any() or not len(rows):
        return None
    player, seen = CachedPoser(outfit), np.zeros(len(covered), np.float32)
    if player.plain:
        return None
    some = np.unique(np.linspace(0, len(rows) - 1, MOST_POSES).round().astype(int))
    outfit.prepare(poses, sorted(rows[index] for index in some))
    for row in (rows[index] for index in some):
        composite = player.composite(poses, row)
        for camera in _cameras(outfit, poses, row):
            share = contributions(composite, camera) / footprints(composite, camera)
            np.maximum(seen, share[: len(covered)].numpy(), out=seen)
    maps = outfit.layers[0].maps
    shown = spread(
        ~covered | (seen >= LEAST_CONTRIBUTION), maps.neighbours.numpy(), round(MARGIN / maps.pitch)
    )
    return None if shown.all() else ~shown


def fully_covered(outfit: Outfit) -> NDArray[np.bool_]:
    """(N,) texels of the body that a garment on the same grid covers wholly."""
    body = outfit.layers[0].maps
    covered = np.zeros(len(body), bool)
    if outfit.layers[0].name == BODY:
        for layer in outfit.layers[1:]:
            if same_grid(body, layer.maps):
                covered |= covered_weights(body, layer.maps) >= 1
    return covered


def contributions(composite: Gaussians, camera: Camera) -> Tensor:
    """(N,) sum over pixels of every Gaussian's blending weight in one picture."""
    return splat_contributions(
        composite.means, None, None, composite.opacities, *camera.tensors(), camera.width, camera.height,
        covars=composite.covariances,
    )  # fmt: skip


def footprints(composite: Gaussians, camera: Camera) -> Tensor:
    """(N,) px², 2π times the variance of every Gaussian's image, were it a sphere as wide as it is wide."""
    matrix = torch.from_numpy(camera.camera_from_world).to(composite.means)
    depth = (composite.means @ matrix[2, :3] + matrix[2, 3]).clamp(min=1e-3)
    variance = composite.covariances.diagonal(dim1=1, dim2=2).sum(dim=1) / 2  # of a disc, along its sides
    return 2 * math.pi * (variance * (camera.intrinsics[0, 0] / depth).square() + _BLUR)


def spread(chosen: NDArray[np.bool_], neighbours: NDArray[np.int64], steps: int) -> NDArray[np.bool_]:
    """Texels within so many steps of chosen ones; neighbours (N, 4), −1 where there is none."""
    for _ in range(steps):
        near = chosen[neighbours] & (neighbours >= 0)
        chosen = chosen | near.any(axis=1)
    return chosen


def _cameras(outfit: Outfit, poses: Poses, row: int) -> list[Camera]:
    """All around a pose, some from below and from above."""
    joints = posed_joints(outfit.body_model, *pose_tensors(poses, row, outfit.betas)).numpy()
    middle = (joints.min(axis=0) + joints.max(axis=0)) / 2.0
    reach = float(np.linalg.norm(joints - middle, axis=1).max()) + _REACH
    return [
        look_at_camera("", middle.astype(np.float64), first + 2 * np.pi * index / count, (reach,) * 3,
                       (_SIDE, _SIDE), tilt)
        for tilt, count, first in _AROUND
        for index in range(count)
    ]  # fmt: skip

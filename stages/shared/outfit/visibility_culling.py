"""Finds body Gaussians that garments hide in a whole motion, so that they need not be posed or drawn.

A body texel is hidden when three things hold. A garment covers it fully (`covered_weights` is 1). In sampled
poses of the motion, seen from all around, above and below, its contribution to every picture is negligible.
The same is true of all texels within a margin. The contribution of a Gaussian to a picture is the sum of its
blending weights, divided by the area of its image.

The result is valid for one outfit: without a garment, more of the body is visible.
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
from stages.shared.splat.api import contributions
from stages.shared.splat.gaussians import Gaussians

LEAST_CONTRIBUTION = 0.0013  # share of the unoccluded contribution: a third of one of 255 levels
MARGIN = 0.013  # m around visible texels that are drawn as well
MOST_POSES = 12
LEAST_PICTURES = 300
"""With fewer pictures the search takes longer than it saves."""
_BLUR = 0.3  # px², of the splatter
_SIDE = 256  # px, side of the sampled pictures
_REACH = 0.25  # m around the joints
_AROUND = ((0.08, 5, 0.0), (-0.7, 3, 0.5), (1.2, 2, 0.9))  # tilt, number of cameras, first azimuth


def find_hidden_texels(outfit: Outfit, poses: Poses, rows: Sequence[int]) -> NDArray[np.bool_] | None:
    """(N,) texels of the body that need not be drawn in a motion; None where all are needed.

    Arguments:
        poses: the motion. rows: those that will be rendered; `MOST_POSES` of them are sampled.
    """
    covered = fully_covered(outfit)
    if not covered.any() or not len(rows):
        return None
    poser, largest = CachedPoser(outfit), np.zeros(len(covered), np.float32)
    if poser.plain:
        return None
    picked = np.unique(np.linspace(0, len(rows) - 1, MOST_POSES).round().astype(int))
    sampled = [rows[index] for index in picked]
    outfit.prepare(poses, sorted(sampled))
    for row in sampled:
        composite = poser.composite(poses, row)
        for camera in _cameras(outfit, poses, row):
            share = contributions(composite, camera) / footprints(composite, camera)
            np.maximum(largest, share[: len(covered)].numpy(), out=largest)
    maps = outfit.layers[0].maps
    shown = dilate(
        ~covered | (largest >= LEAST_CONTRIBUTION), maps.neighbours.numpy(), round(MARGIN / maps.pitch)
    )
    return None if shown.all() else ~shown


def fully_covered(outfit: Outfit) -> NDArray[np.bool_]:
    """(N,) texels of the body that a garment on the same grid covers fully."""
    body = outfit.layers[0].maps
    covered = np.zeros(len(body), bool)
    if outfit.layers[0].name == BODY:
        for layer in outfit.layers[1:]:
            if same_grid(body, layer.maps):
                covered |= covered_weights(body, layer.maps) >= 1
    return covered


def footprints(composite: Gaussians, camera: Camera) -> Tensor:
    """(N,) px², area of the image of every Gaussian: 2π times the variance of a sphere of the same width."""
    matrix = torch.from_numpy(camera.camera_from_world).to(composite.means)
    depth = (composite.means @ matrix[2, :3] + matrix[2, 3]).clamp(min=1e-3)
    variance = composite.covariances.diagonal(dim1=1, dim2=2).sum(dim=1) / 2  # of a disc, along each axis
    return 2 * math.pi * (variance * (camera.intrinsics[0, 0] / depth).square() + _BLUR)


def dilate(texels: NDArray[np.bool_], neighbours: NDArray[np.int64], steps: int) -> NDArray[np.bool_]:
    """(N,) texels within `steps` steps of the given ones; neighbours (N, 4), −1 where there is none."""
    for _ in range(steps):
        near = texels[neighbours] & (neighbours >= 0)
        texels = texels | near.any(axis=1)
    return texels


def _cameras(outfit: Outfit, poses: Poses, row: int) -> list[Camera]:
    """Cameras around a pose, some of them below and above it."""
    joints = posed_joints(outfit.body_model, *pose_tensors(poses, row, outfit.betas)).numpy()
    middle = (joints.min(axis=0) + joints.max(axis=0)) / 2.0
    reach = float(np.linalg.norm(joints - middle, axis=1).max()) + _REACH
    return [
        look_at_camera("", middle.astype(np.float64), first + 2 * np.pi * index / count, (reach,) * 3,
                       (_SIDE, _SIDE), tilt)
        for tilt, count, first in _AROUND
        for index in range(count)
    ]  # fmt: skip

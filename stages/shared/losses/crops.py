"""Square crops of a picture: around a mask, and around a face."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from stages.shared.body import BodyModel, Poses, bone_transforms, shaped_joints
from stages.shared.body.skeleton import PARENTS
from stages.shared.capture.camera import Box, Camera

_HEAD = 15
_FACE_ABOVE_JOINT = 0.06  # m, along the head's own up
_FACE_RADIUS = 0.15  # m
_SMALLEST_FACE = 16  # px


def mask_box(mask: Tensor, margin: int = 0) -> Box | None:
    """Tight box of the pixels of a mask (H, W) > 0.5, `margin` px wider and clipped; None where none is."""
    rows, columns = (torch.nonzero((mask > 0.5).any(dim=axis))[:, 0] for axis in (1, 0))
    if not len(rows):
        return None
    height, width = mask.shape
    left, top = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
    return left, top, min(width, int(columns[-1]) + 1 + margin), min(height, int(rows[-1]) + 1 + margin)


def square_crop(image: Tensor, box: Box, side: int, background: Tensor) -> Tensor:
    """(side, side, 3): the box of an image (H, W, 3), centred in a square of `background` (3,), bilinear."""
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    longest = max(width, height)
    x, y = (longest - width) // 2, (longest - height) // 2
    # over the background, so that zeros of the padding stand for it
    part = (image[top:bottom, left:right] - background).permute(2, 0, 1)[None]
    square = functional.pad(part, (x, longest - width - x, y, longest - height - y))
    return functional.interpolate(square, (side, side), mode="bilinear")[0].permute(1, 2, 0) + background


def face_centre(body: BodyModel, poses: Poses, frame: int) -> NDArray[np.float64]:
    """(3,) m, world: 0.06 m above the head joint of a row of `poses`, along the head's own up."""
    rotations, translation = (torch.from_numpy(a[frame]) for a in (poses.rotations, poses.translation))
    joints = shaped_joints(body, torch.from_numpy(poses.betas))
    posed_from_rest = bone_transforms(rotations, joints, PARENTS, translation)[_HEAD].double().numpy()
    centre = joints[_HEAD].double().numpy() + (0.0, _FACE_ABOVE_JOINT, 0.0)
    return np.asarray(posed_from_rest[:3, :3] @ centre + posed_from_rest[:3, 3])


def face_box(camera: Camera, centre: NDArray[np.float64]) -> Box | None:
    """Box of a sphere 0.30 m wide at `centre` (3,) world, clipped; None below 16 px, or behind the camera."""
    pixel, depth = camera.project(centre)
    if depth <= _FACE_RADIUS:
        return None
    reach = _FACE_RADIUS / float(depth) * camera.intrinsics.diagonal()[:2]
    low, high = pixel - reach, pixel + reach
    left, top = max(0, math.floor(low[0])), max(0, math.floor(low[1]))
    right, bottom = min(camera.width, math.ceil(high[0])), min(camera.height, math.ceil(high[1]))
    return (left, top, right, bottom) if min(right - left, bottom - top) >= _SMALLEST_FACE else None

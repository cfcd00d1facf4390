"""One frame's pose as the avatar needs it: bone transforms for the world and for the network's input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body import BodyModel, Poses, posed_from_canonical
from stages.shared.body.posed import pose_tensors


@dataclass(frozen=True)
class FramePose:
    """Pose of one frame.

    Attributes:
        transforms: (55, 4, 4) posed_from_canonical with shape, root rotation and translation: canonical to
            world.
        local_transforms: (55, 4, 4) the same pose with zero shape and without root rotation and translation.
        betas: (10,) shape.
        motion: (M,) what `recent_motion` says of the frames before; None for a still pose.
    """

    transforms: Tensor
    local_transforms: Tensor
    betas: Tensor
    motion: Tensor | None = None

    def to(self, device: torch.device | str) -> FramePose:
        """The same pose on `device`."""
        motion = None if self.motion is None else self.motion.to(device)
        return FramePose(
            self.transforms.to(device), self.local_transforms.to(device), self.betas.to(device), motion
        )


def frame_pose(
    body: BodyModel, rotations: Tensor, translation: Tensor, betas: Tensor, motion: Tensor | None = None
) -> FramePose:
    """Pose from joint rotations (55, 3) axis-angle rad, root translation (3,) m and shape (10,).

    Leading axes of rotations and translation are kept: many moments at once.
    """
    local = rotations.clone()
    local[..., 0, :] = 0.0
    zero = torch.zeros_like(translation)
    return FramePose(
        transforms=posed_from_canonical(body, rotations, translation, betas),
        local_transforms=posed_from_canonical(body, local, zero, torch.zeros_like(betas)),
        betas=betas,
        motion=motion,
    )


def pose_at(
    body: BodyModel,
    poses: Poses,
    rows: int | slice | list[int],
    betas: NDArray[np.float32] | None = None,
    motion: Tensor | None = None,
) -> FramePose:
    """Pose of a row of `poses`; several rows give leading axes.

    Arguments:
        betas: (10,) shape to use instead of the shape of the poses. motion: (M,) `recent_motion` of the row.
    """
    return frame_pose(body, *pose_tensors(poses, rows, betas), motion)

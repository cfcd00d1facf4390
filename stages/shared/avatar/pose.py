"""The pose of a frame, and the recent motion of the body, which a pose alone does not show.

Motion features: rates (velocity and turning of the root in its own frame, turning of the 21 body joints) fade
into leaky integrators with time constants of 0.1, 0.3, 0.9 … s: m ← m + (1 − e^(−dt/τ)) (rate − m). The last
feature is the direction of up as the root sees it. A still pose, and the first of a sequence, has no motion:
zeros. Times are in seconds, so a pose file at another frame rate means the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body import BodyModel, Poses, posed_from_canonical
from stages.shared.body.posed import pose_tensors
from stages.shared.finite import finite

_JOINTS = 22  # root and body, without face and fingers
_FASTEST, _RATIO = 0.1, 3.0  # s, between time constants
_REMEMBERED = 5.0  # time constants
UP, RATES = 3, 3 + 3 * _JOINTS


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


def motion_length(memories: int) -> int:
    """Numbers that `recent_motion` answers."""
    return UP + memories * RATES if memories else 0


def time_constant(memory: int) -> float:
    """Seconds after which a memory has faded to 1/e."""
    return _FASTEST * _RATIO**memory


def recent_motion(poses: Poses, frame: int, memories: int) -> Tensor:
    """(3 + 69 K,) up direction, then K memories: root velocity (m/s), root turning, joint turning (rad/s).

    Arguments:
        poses: sequence; rows before `frame` are its past, as far as five of the longest time constants.
    """
    return recent_motions(poses, range(frame, frame + 1), memories)[0]


def recent_motions(poses: Poses, frames: range, memories: int) -> Tensor:
    """(R, 3 + 69 K) `recent_motion` of rows one after the other, at little more than the cost of one."""
    if not memories or not len(frames):
        return torch.zeros(len(frames), 0)
    import roma  # loads the whole of torch._dynamo: two seconds

    reach = math.ceil(_REMEMBERED * time_constant(memories - 1) * poses.fps)
    first, end = max(0, frames[0] - reach), frames[-1] + 1
    turned = roma.rotvec_to_rotmat(torch.from_numpy(poses.rotations[first:end, :_JOINTS]).double())
    places = torch.from_numpy(poses.translation[first:end].astype(np.float64))
    root = turned[:, 0]
    velocity = ((places[1:] - places[:-1])[:, None] @ root[1:])[:, 0]
    turning = roma.rotmat_to_rotvec(turned[:-1].transpose(-1, -2) @ turned[1:])
    rates = torch.cat((velocity, turning.flatten(start_dim=1)), dim=1) * poses.fps
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    shares = [_shares(poses.fps, memory, min(reach, len(rates))) for memory in range(memories)]
    found = torch.zeros(len(frames), motion_length(memories), dtype=torch.float64)
    for row, frame in enumerate(frames):
        here = frame - first
        past = rates[max(0, here - reach) : here]
        held = [share[len(share) - len(past) :] @ past for share in shares]
        found[row] = torch.cat((root[here].T @ up, *held))
    poses_seen = {"rotations": poses.rotations, "translation": poses.translation}
    return finite(found.float(), "recent_motion", **poses_seen)


def _shares(fps: float, memory: int, count: int) -> Tensor:
    """(count,) how much of the rates before a moment its memory holds, the latest last."""
    fading = math.exp(-1.0 / (fps * time_constant(memory)))
    return (1 - fading) * fading ** torch.arange(count - 1, -1, -1, dtype=torch.float64)


def motion_scale(motions: Tensor, usual: Tensor | float, least: float) -> Tensor:
    """(H,) factors that make every memory's usual difference between moments `usual`; up stays as it is.

    Arguments:
        motions: (T, H) of the training poses. least: m/s and rad/s; less is noise.
    """
    scale = torch.ones(motions.shape[1], dtype=motions.dtype)
    memories = motions[:, UP:].reshape(len(motions), -1, RATES)
    spread = (memories - memories.mean(dim=0)).square().sum(dim=2).mean(dim=0).sqrt()
    scale[UP:] = (usual / spread.clamp(min=least)).repeat_interleave(RATES)
    return finite(scale, "motion_scale", motions=motions)

"""The poses a trained network is asked about: those it was trained in, and some in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.distill.config import DistillConfig
from stages.shared.avatar.motion import recent_motion
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import BodyModel, Poses


@dataclass(frozen=True)
class Samples:
    """Moments to ask a network about.

    Attributes:
        poses: (55, 4, 4) bone transforms without shape and root, of each.
        moments: the motion that each belongs to, and its row there.
        training: how many of them, the first, are training poses.
    """

    poses: list[Tensor]
    moments: list[tuple[Poses, int]]
    training: int

    def motions(self, memories: int) -> list[Tensor] | None:
        """(H,) recent motion of each, as a model of so many memories wants it; None for none."""
        if not memories:
            return None
        return [recent_motion(motion, row, memories) for motion, row in self.moments]


def sample_poses(body: BodyModel, training: Poses, extra: Sequence[Poses], config: DistillConfig) -> Samples:
    """The training poses, evenly spread; then blends of random pairs of them; then other motions.

    A blend has the recent motion of the nearer of its two.
    """
    chosen = _evenly(training, config.training_poses)
    rotations = [torch.from_numpy(training.rotations[row]) for row in chosen]
    moments: list[tuple[Poses, int]] = [(training, row) for row in chosen]
    draw = np.random.default_rng(config.seed)
    if len(chosen) > 1:
        for _ in range(config.blended_poses):
            one, other = draw.choice(len(chosen), size=2, replace=False)
            share = float(draw.uniform(0.0, 0.75))
            rotations.append(blend_rotations(rotations[one], rotations[other], share))
            moments.append((training, chosen[one if share < 0.5 else other]))
    for motion in extra:
        for row in _evenly(motion, config.extra_poses):
            rotations.append(torch.from_numpy(motion.rotations[row]))
            moments.append((motion, row))
    return Samples([_local(body, rotation) for rotation in rotations], moments, len(chosen))


def blend_rotations(one: Tensor, other: Tensor, share: float) -> Tensor:
    """(55, 3) axis-angle `share` of the way from `one` to `other` along each joint's shortest arc."""
    import roma  # loads the whole of torch._dynamo: two seconds

    start, end = roma.rotvec_to_unitquat(one), roma.rotvec_to_unitquat(other)
    steps = torch.tensor([share], dtype=one.dtype)
    return roma.unitquat_to_rotvec(roma.unitquat_slerp(start, end, steps, shortest_arc=True)[0])


def _evenly(motion: Poses, count: int) -> list[int]:
    return sorted({round(row) for row in np.linspace(0, len(motion) - 1, min(count, len(motion)))})


def _local(body: BodyModel, rotations: Tensor) -> Tensor:
    return frame_pose(body, rotations, torch.zeros(3), torch.zeros(10)).local_transforms

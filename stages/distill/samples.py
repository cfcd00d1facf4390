"""The poses a trained network is asked about: those it was trained in, and some in between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import roma
import torch
from torch import Tensor

from stages.distill.config import DistillConfig
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import BodyModel, Poses


def sample_poses(
    body: BodyModel, training: Poses, extra: Sequence[Poses], config: DistillConfig
) -> tuple[list[Tensor], int]:
    """Bone transforms (55, 4, 4) without shape and root of all poses to ask about; how many are training's.

    First the training poses, evenly spread; then blends of random pairs of them; then those of other motions.
    """
    chosen = _evenly(training, config.training_poses)
    rotations = [torch.from_numpy(training.rotations[row]) for row in chosen]
    draw = np.random.default_rng(config.seed)
    blended = []
    if len(rotations) > 1:
        for _ in range(config.blended_poses):
            one, other = draw.choice(len(rotations), size=2, replace=False)
            blended.append(blend_rotations(rotations[one], rotations[other], float(draw.uniform(0.25, 0.75))))
    for motion in extra:
        rows = _evenly(motion, config.extra_poses)
        blended += [torch.from_numpy(motion.rotations[row]) for row in rows]
    return [_local(body, rotation) for rotation in rotations + blended], len(rotations)


def blend_rotations(one: Tensor, other: Tensor, share: float) -> Tensor:
    """(55, 3) axis-angle `share` of the way from `one` to `other` along each joint's shortest arc."""
    start, end = roma.rotvec_to_unitquat(one), roma.rotvec_to_unitquat(other)
    steps = torch.tensor([share], dtype=one.dtype)
    return roma.unitquat_to_rotvec(roma.unitquat_slerp(start, end, steps, shortest_arc=True)[0])


def _evenly(motion: Poses, count: int) -> list[int]:
    return sorted({round(row) for row in np.linspace(0, len(motion) - 1, min(count, len(motion)))})


def _local(body: BodyModel, rotations: Tensor) -> Tensor:
    return frame_pose(body, rotations, torch.zeros(3), torch.zeros(10)).local_transforms

"""Fits a motion to legs of another length: pelvis path scaled, feet on the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body import JOINT_INDEX, BodyModel, Poses, posed_vertices, shaped_joints
from stages.shared.body.posed import pose_tensors

_SIDES = ("left", "right")
_SAMPLES = 24  # frames in which the floor is measured

Floats = NDArray[np.float32]


def fix_foot_height(poses: Poses, body: BodyModel, betas: Floats) -> Poses:
    """The motion for a wearer of shape `betas` (10,); unchanged where the motion was made for that shape.

    The path of the pelvis is scaled by the ratio of the leg lengths, about its first position on the floor.
    Then the lowest vertex of the clip gets the height it had before. The floor is assumed to be level.
    """
    if np.allclose(poses.betas, betas, atol=1e-6) or not len(poses):
        return poses
    made_for, wearer = (_rest(body, shape) for shape in (poses.betas, betas))
    ratio = _leg_length(wearer) / _leg_length(made_for)
    frames = np.unique(np.linspace(0, len(poses) - 1, _SAMPLES).round().astype(int))
    floor = _lowest(poses, body, poses.betas, frames)
    pelvis = poses.translation.astype(np.float64) + made_for[0]
    origin = pelvis[0] * [1, 0, 1] + [0, floor, 0]
    translation = origin + ratio * (pelvis - origin) - wearer[0]
    moved = replace(poses, translation=translation.astype(np.float32), betas=np.asarray(betas, np.float32))
    translation[:, 1] += floor - _lowest(moved, body, betas, frames)
    return replace(moved, translation=translation.astype(np.float32))


def _rest(body: BodyModel, betas: Floats) -> NDArray[np.float64]:
    """(55, 3) m joints at rest."""
    return shaped_joints(body, torch.from_numpy(np.asarray(betas, np.float32))).double().numpy()


def _leg_length(joints: NDArray[np.float64]) -> float:
    """Hip to knee to ankle, mean of both sides."""
    sides = [[joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("hip", "knee", "ankle")] for side in _SIDES]
    return float(np.mean([np.linalg.norm(b - a) + np.linalg.norm(c - b) for a, b, c in sides]))


def _lowest(poses: Poses, body: BodyModel, betas: Floats, frames: NDArray[np.intp]) -> float:
    """Lowest height of any vertex of the body in these frames."""
    lowest = np.inf
    for frame in frames:
        vertices = posed_vertices(body, *pose_tensors(poses, int(frame), betas))
        lowest = min(lowest, float(vertices[:, 1].min()))
    return lowest

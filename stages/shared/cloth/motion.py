"""From a pose sequence to the steps of a simulation: lead-in, cuts, and frames that are far apart.

Before the first frame, and after every cut, the body moves from the template's pose into the frame's pose and
waits there until the cloth has settled. These steps are simulated and never shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from stages.shared.body import BodyModel, Poses, posed_joints
from stages.shared.finite import require_finite

Doubles = NDArray[np.float64]

LEAD_IN_FRAMES = 24  # moving from the template's pose, at LEAD_IN_FPS
SETTLE_FRAMES = 12  # waiting in the pose
STILL_SETTLE_FRAMES = 30  # the same before a single pose
LEAD_IN_FPS = 30.0
LONGEST_STEP = 1 / 20  # seconds; slower motions are interpolated, because a linear path would cut corners
FASTEST_JOINT = 18.0  # m/s; no hand or foot of a human is faster, so it is a cut
_FIRST_FACE_JOINT = 22


@dataclass(frozen=True, eq=False)
class BodyStep:
    """The body at the end of a step: rotations (55, 3) axis-angle, translation (3,) m; seconds it takes."""

    rotations: Doubles
    translation: Doubles
    seconds: float


def is_cut(body: BodyModel, poses: Poses, row: int) -> bool:
    """Whether the body cannot have moved from the row before to this one: a joint would be too fast."""
    if row == 0:
        return True
    rows = [row - 1, row]
    arrays = (poses.rotations[rows], poses.translation[rows], np.stack([poses.betas] * 2))
    joints = posed_joints(body, *(torch.as_tensor(array, dtype=torch.float64) for array in arrays)).numpy()
    moved = np.linalg.norm(joints[1, :_FIRST_FACE_JOINT] - joints[0, :_FIRST_FACE_JOINT], axis=1).max()
    return bool(moved * poses.fps > FASTEST_JOINT)


def lead_in(template_pose: NDArray, poses: Poses, row: int) -> Iterator[BodyStep]:
    """Steps from the template's pose to a row, the first of them in the template's pose itself.

    The body already stands where the row has it, and faces the same way, so that it only moves its limbs.
    """
    goal = poses.rotations[row].astype(np.float64)
    require_finite("lead_in", rotations=goal, translation=poses.translation[row])
    start = np.array(template_pose, dtype=np.float64)
    start[0] = _facing(start[0], goal[0])
    paths = [Slerp([0.0, 1.0], Rotation.from_rotvec([a, b])) for a, b in zip(start, goal, strict=True)]
    settle = STILL_SETTLE_FRAMES if len(poses) == 1 else SETTLE_FRAMES
    shares = np.clip(np.arange(LEAD_IN_FRAMES + settle + 1) / LEAD_IN_FRAMES, 0.0, 1.0)
    shares = shares * shares * (3 - 2 * shares)
    place = poses.translation[row].astype(np.float64)
    for share in shares:
        rotations = np.stack([path(share).as_rotvec() for path in paths]) if share < 1 else goal
        yield BodyStep(rotations, place, 1 / LEAD_IN_FPS)


def steps_between(poses: Poses, row: int) -> Iterator[BodyStep]:
    """Steps from the row before to a row ≥ 1, each at most LONGEST_STEP long."""
    seconds = 1.0 / poses.fps
    count = max(1, int(np.ceil(seconds / LONGEST_STEP)))
    first, last = (poses.rotations[r].astype(np.float64) for r in (row - 1, row))
    before, after = (poses.translation[r].astype(np.float64) for r in (row - 1, row))
    if count > 1:
        paths = [Slerp([0.0, 1.0], Rotation.from_rotvec([a, b])) for a, b in zip(first, last, strict=True)]
    for number in range(1, count + 1):
        share = number / count
        rotations = last if number == count else np.stack([path(share).as_rotvec() for path in paths])
        yield BodyStep(rotations, before + share * (after - before), seconds / count)


def _facing(template_root: Doubles, root: Doubles) -> Doubles:
    """The template's root rotation (3,), turned about the vertical to face the way of `root` (3,)."""
    turn = Rotation.from_rotvec(root) * Rotation.from_rotvec(template_root).inv()
    _, y, _, w = turn.as_quat()
    size = np.hypot(y, w)
    if size < 1e-9:
        return template_root
    about_vertical = Rotation.from_quat([0.0, y / size, 0.0, w / size])
    return np.asarray((about_vertical * Rotation.from_rotvec(template_root)).as_rotvec())

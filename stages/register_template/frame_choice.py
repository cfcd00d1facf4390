"""Which frame makes the best template: arms away from the torso, legs apart, little motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body.kinematics import posed_joints
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX

# Distances beyond which more openness is no better, metres.
_WRIST_CAP, _ANKLE_CAP = 0.40, 0.35
_MOTION_SECONDS = 0.05  # metres of openness given up for each metre per second of motion
MERGED_M = 0.20  # less openness than this: limbs touch each other or the trunk
_EQUAL = 0.02  # frames this close to the best are as good; the earliest of them is taken


def choose_frame(body: BodyModel, poses: Poses, frames: Sequence[int]) -> int:
    """The frame whose pose opens the body most without fast motion; the earliest of those that are as good.

    Arguments:
        poses: row = frame number.
        frames: the candidates.
    """
    joints = _joints(body, poses)
    scores = _openness(joints)
    if len(poses) > 1:
        speed = np.linalg.norm(np.gradient(joints, axis=0), axis=-1).mean(axis=1) * poses.fps
        scores = scores - _MOTION_SECONDS * speed
    scores = scores[list(frames)]
    return int(np.asarray(frames)[np.flatnonzero(scores >= scores.max() - _EQUAL)[0]])


def openness(body: BodyModel, poses: Poses) -> NDArray[np.float64]:
    """(T,) metres: the smaller of arm-to-torso and ankle distance."""
    return _openness(_joints(body, poses))


def _joints(body: BodyModel, poses: Poses) -> NDArray[np.float64]:
    with torch.no_grad():
        joints = posed_joints(
            body,
            torch.from_numpy(poses.rotations).double(),
            torch.from_numpy(poses.translation).double(),
            torch.from_numpy(poses.betas).double(),
        )
    return joints.numpy()


def _openness(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    def place(name: str) -> NDArray[np.float64]:
        return joints[:, JOINT_INDEX[name]]

    torso = np.linspace(place("pelvis"), place("neck"), 9, axis=1)
    thighs = [
        np.linspace(place(f"{side}_hip"), place(f"{side}_knee"), 5, axis=1) for side in ("left", "right")
    ]
    trunk = np.concatenate([torso, *thighs], axis=1)
    wrists = [
        np.linalg.norm(trunk - place(f"{side}_wrist")[:, None], axis=-1).min(axis=1)
        for side in ("left", "right")
    ]
    elbows = [
        np.linalg.norm(trunk - place(f"{side}_elbow")[:, None], axis=-1).min(axis=1)
        for side in ("left", "right")
    ]
    ankles = np.linalg.norm(place("left_ankle") - place("right_ankle"), axis=-1)
    arms = np.minimum(np.minimum(*wrists), np.minimum(*elbows) * 1.5)
    return np.minimum(np.minimum(arms, _WRIST_CAP), np.minimum(ankles, _ANKLE_CAP))

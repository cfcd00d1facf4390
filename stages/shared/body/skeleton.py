"""The 55 joints of the SMPL-X convention: names, parents, and groups that readers of pose files need."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_FINGERS: Final = ("index", "middle", "pinky", "ring", "thumb")

JOINTS: Final[tuple[str, ...]] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "jaw",
    "left_eye_smplhf",
    "right_eye_smplhf",
    *(f"left_{finger}{knuckle}" for finger in _FINGERS for knuckle in (1, 2, 3)),
    *(f"right_{finger}{knuckle}" for finger in _FINGERS for knuckle in (1, 2, 3)),
)

_BODY_PARENTS: Final = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15)


def _hand_parents(first: int, wrist: int) -> tuple[int, ...]:
    """Five fingers of three joints: the first hangs on the wrist, the others on the joint before."""
    return tuple(wrist if joint % 3 == 0 else first + joint - 1 for joint in range(15))


PARENTS: Final[tuple[int, ...]] = _BODY_PARENTS + _hand_parents(25, 20) + _hand_parents(40, 21)
JOINT_COUNT: Final = 55
SHAPE_COUNT: Final = 10
EXPRESSION_COUNT: Final = 10
JOINT_INDEX: Final[dict[str, int]] = {name: index for index, name in enumerate(JOINTS)}

# Slices of the 55 rotations, in the order of every SMPL-X pose vector.
BODY: Final = slice(1, 22)
JAW: Final = 22
LEFT_EYE: Final = 23
RIGHT_EYE: Final = 24
LEFT_HAND: Final = slice(25, 40)
RIGHT_HAND: Final = slice(40, 55)


def parents_array() -> NDArray[np.int32]:
    """Parents as (55,) int32, −1 for the root."""
    return np.array(PARENTS, dtype=np.int32)

"""What a motion may need before it is worn: another up axis, other hands, the corrections known for AMASS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX, LEFT_HAND, RIGHT_HAND
from stages.shared.errors import UsageProblem
from stages.shared.poses.amass import Y_UP_FROM_Z_UP, y_up_roots

UPS = ("auto", "y", "z")
HANDS = ("file", "flat", "relaxed")
_RAISED_COLLARS = 0.3  # radians about z


def y_up_from_z_up(poses: Poses, body: BodyModel | None = None) -> Poses:
    """A motion whose world has z up, in the y-up world of `gw`.

    The body turns about the world's origin, so its translation, which is that of the root joint's rest place,
    turns about the pelvis of `body` (of a mean body at the origin without one).
    """
    pelvis = np.zeros(3) if body is None else body.joint_template[0].astype(np.float64)
    moved = (poses.translation.astype(np.float64) + pelvis) @ Y_UP_FROM_Z_UP.T - pelvis
    turned = y_up_roots(poses.rotations.astype(np.float64))
    return replace(poses, rotations=turned.astype(np.float32), translation=moved.astype(np.float32))


def with_hands(poses: Poses, hands: str, body: BodyModel | None = None) -> Poses:
    """The motion with the hands of its file ("file"), stretched out ("flat"), or at rest ("relaxed").

    Raises:
        UsageProblem: an unknown kind, or a body model without relaxed hands.
    """
    if hands not in HANDS:
        raise UsageProblem(
            f"There are no hands called {hands!r}.", "option --hands", "Choose of: " + ", ".join(HANDS) + "."
        )
    if hands == "file":
        return poses
    rotations = poses.rotations.copy()
    for joints, side in ((LEFT_HAND, "left"), (RIGHT_HAND, "right")):
        mean = None if body is None else getattr(body, f"hand_mean_{side}")
        if hands == "relaxed" and mean is None:
            raise UsageProblem(
                "This body model knows no relaxed hand.",
                "option --hands",
                "Choose flat, or give another --body-model.",
            )
        rotations[:, joints] = 0.0 if hands == "flat" or mean is None else mean.reshape(15, 3)
    return replace(poses, rotations=rotations)


def amass_corrected(poses: Poses) -> Poses:
    """The motion with raised collars, the head not nodding, straight wrists (Animatable Gaussians).

    Fits of motion capture without images hang the collars and twist wrists and head; these are the
    corrections that its authors apply to AMASS before driving an avatar.
    """
    rotations = poses.rotations.copy()
    rotations[:, JOINT_INDEX["left_collar"], 2] += _RAISED_COLLARS
    rotations[:, JOINT_INDEX["right_collar"], 2] -= _RAISED_COLLARS
    rotations[:, JOINT_INDEX["head"], 0] = 0.0
    for side in ("left", "right"):
        rotations[:, JOINT_INDEX[f"{side}_wrist"]] = 0.0
    return replace(poses, rotations=rotations)

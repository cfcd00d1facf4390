"""Prior of pose and shape: spread and limits of the joints' angles, and normally distributed betas.

The table holds rounded anatomical ranges of standing, walking and sport. The axes are those of
the rest pose (T-pose, +x the subject's left, +y up, +z forward), angles in degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from stages.register_template.fitting.bones import Doubles
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, LEFT_HAND, RIGHT_HAND, SHAPE_COUNT

_LIMIT_SPREAD = np.radians(4.0)  # an angle this far beyond its limit costs as much as one spread
# Joint: spread about the rest pose, then [lowest, highest] about x, y, z. "left" stands for both sides:
# about y and z the right side has the mirrored range.
_TABLE: dict[str, tuple[float, tuple[tuple[float, float], ...]]] = {
    "pelvis": (1e4, ((-720, 720), (-720, 720), (-720, 720))),
    "spine1": (12, ((-25, 45), (-25, 25), (-25, 25))),
    "spine2": (9, ((-20, 35), (-20, 20), (-20, 20))),
    "spine3": (9, ((-20, 30), (-20, 20), (-20, 20))),
    "neck": (15, ((-35, 45), (-45, 45), (-35, 35))),
    "head": (15, ((-35, 45), (-45, 45), (-35, 35))),
    "left_hip": (45, ((-125, 40), (-60, 60), (-35, 80))),
    "left_knee": (50, ((-3, 150), (-12, 12), (-8, 8))),
    "left_ankle": (10, ((-35, 40), (-25, 25), (-20, 20))),
    "left_foot": (5, ((-30, 25), (-10, 10), (-10, 10))),
    "left_collar": (8, ((-15, 15), (-30, 20), (-20, 30))),
    "left_shoulder": (50, ((-100, 100), (-120, 60), (-110, 110))),
    "left_elbow": (50, ((-100, 100), (-150, 4), (-15, 15))),
    "left_wrist": (12, ((-60, 60), (-35, 35), (-75, 75))),
}
_FINGER_SPREAD, _STILL_SPREAD = 20.0, 1.0  # degrees; eyes and jaw stay
SHAPE_SPREAD = 1.0
SHAPE_LIMIT = 3.0  # standard deviations: of each beta, one person in 370 is beyond
_SHAPE_WALL = 1e7


@dataclass(frozen=True, eq=False)
class Prior:
    """Costs of poses and shapes, with derivatives for `solve.step`.

    Attributes:
        near: (T, 55, 3) poses that each frame should stay close to, or None.
        near_spread: (55,) radians by which they may differ.
        shape_weight: of the betas' spread against that of the joints.
    """

    near: Doubles | None = None
    near_spread: Doubles | None = None
    shape_weight: float = 1.0

    def pose(self, rotations: Doubles, frame: int) -> tuple[Doubles, Doubles]:
        """Hessian (165, 165) and slope (165,) with respect to small turns of the joints in parents' axes."""
        spread, low, high = limits()
        flat = rotations.reshape(-1)
        beyond = np.where(flat < low, flat - low, np.where(flat > high, flat - high, 0.0))
        slope = flat / spread**2 + beyond / _LIMIT_SPREAD**2
        diagonal = 1 / spread**2 + (beyond != 0) / _LIMIT_SPREAD**2
        if self.near is not None:
            assert self.near_spread is not None
            precision = np.repeat(1 / self.near_spread**2, 3)
            slope = slope + precision * (flat - self.near[frame].reshape(-1))
            diagonal = diagonal + precision
        hessian, tilted = np.zeros((3 * JOINT_COUNT, 3 * JOINT_COUNT)), np.zeros(3 * JOINT_COUNT)
        for joint in range(JOINT_COUNT):
            part = slice(3 * joint, 3 * joint + 3)
            change = _angle_by_turn(rotations[joint])
            hessian[part, part] = change.T @ (diagonal[part, None] * change)
            tilted[part] = change.T @ slope[part]
        return hessian, tilted

    def shape(self, betas: Doubles) -> tuple[Doubles, Doubles]:
        """Diagonal (10,) and slope (10,) with respect to the betas."""
        precision = self.shape_weight / SHAPE_SPREAD**2
        # Contours and scans outweigh a normal prior by far, so betas have limits, too.
        beyond = betas - np.clip(betas, -SHAPE_LIMIT, SHAPE_LIMIT)
        diagonal = np.full(SHAPE_COUNT, precision) + (beyond != 0) * _SHAPE_WALL
        return diagonal, precision * betas + _SHAPE_WALL * beyond


def _angle_by_turn(vector: Doubles) -> Doubles:
    """(3, 3) derivative of an axis-angle vector with respect to a small turn before it."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-4:
        return np.eye(3) - cross / 2
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * max(np.sin(angle), 1e-6))
    return np.eye(3) - cross / 2 + factor * cross @ cross


@cache
def limits() -> tuple[Doubles, Doubles, Doubles]:
    """Spread, lowest and highest angle of all joints' components, each (165,), radians."""
    spread = np.full((JOINT_COUNT, 3), _STILL_SPREAD)
    low, high = np.full((JOINT_COUNT, 3), -90.0), np.full((JOINT_COUNT, 3), 90.0)
    spread[LEFT_HAND], spread[RIGHT_HAND] = _FINGER_SPREAD, _FINGER_SPREAD
    for name, (width, ranges) in _TABLE.items():
        joint = JOINT_INDEX[name]
        spread[joint] = width
        low[joint], high[joint] = np.array(ranges, float).T
        if name.startswith("left_"):
            other = JOINT_INDEX["right_" + name.removeprefix("left_")]
            spread[other] = width
            mirrored = [(a, b) if axis == 0 else (-b, -a) for axis, (a, b) in enumerate(ranges)]
            low[other], high[other] = np.array(mirrored, float).T
    return np.radians(spread).reshape(-1), np.radians(low).reshape(-1), np.radians(high).reshape(-1)

"""Which points of an unlabelled scan are bare skin, from their colour and their place on the body.

Most people show their hands, so the scan's colour there is the colour of this person's skin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.register_template.fitting.bones import Doubles
from stages.register_template.fitting.scan_terms import Nearest, ScanPoints
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_INDEX

_NEAR_M = 0.04
_FEWEST_POINTS = 20
_SPREAD_FLOOR = 0.05  # of the logarithms of colour ratios
_SPREAD_TIMES = 3.0
_DARKEST, _BRIGHTEST = 0.35, 1.8  # brightness against the hands' median
_CONTACT = {"bare": 1.0, "often": 0.3, "covered": 0.05}
_BARE = ("wrist", "index", "middle", "pinky", "ring", "thumb", "jaw")
_OFTEN = ("neck", "head", "elbow")
_SMOOTHED_OVER = 12  # neighbours that are averaged


def guess_contact(body: BodyModel, near: Nearest, scan: ScanPoints) -> Doubles:
    """(M,) contact of each scan point with the skin, from its place on the body and its colour."""
    joints = body.skin_weights[body.faces[near.faces]].mean(axis=1).argmax(axis=1)
    by_joint = contact_of_joints()[joints]
    by_color = None if scan.colors is None else _like_hands(scan.colors, joints, near.squared)
    if by_color is None:
        return by_joint
    share = by_color[scan.tree.query(scan.points, min(_SMOOTHED_OVER, len(by_color)))[1]].mean(axis=1)
    return np.where(share > 0.6, 1.0, np.where(share < 0.3, 0.0, 0.2 * by_joint))


def _like_hands(colors: Doubles, joints: NDArray, squared: Doubles) -> Doubles | None:
    """(M,) 1 where a point has the colour of the hands; None where too few points are near the hands."""
    hands = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"], *range(25, 55)]
    known = np.isin(joints, hands) & (squared < _NEAR_M**2)
    if known.sum() < _FEWEST_POINTS:
        return None
    ratios, brightness = _ratios(colors)
    centre = np.median(ratios[known], axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(ratios[known] - centre), axis=0), _SPREAD_FLOOR)
    typical = np.median(brightness[known])
    alike = (np.abs(ratios - centre) < _SPREAD_TIMES * spread).all(axis=1)
    lit = (brightness > _DARKEST * typical) & (brightness < _BRIGHTEST * typical)
    return (alike & lit).astype(np.float64)


def _ratios(colors: Doubles) -> tuple[Doubles, Doubles]:
    """Logarithms of red/green and green/blue (M, 2), which light changes little, and brightness (M,)."""
    safe = np.maximum(colors, 2 / 255)
    logs = np.log(safe)
    return np.stack([logs[:, 0] - logs[:, 1], logs[:, 1] - logs[:, 2]], axis=1), safe.mean(axis=1)


def contact_of_joints() -> Doubles:
    """(55,) contact of points whose largest skinning weight is each joint's."""
    contact = np.full(len(JOINT_INDEX), _CONTACT["covered"])
    for name, joint in JOINT_INDEX.items():
        part = name.removeprefix("left_").removeprefix("right_").rstrip("123")
        if part in _BARE:
            contact[joint] = _CONTACT["bare"]
        elif part in _OFTEN:
            contact[joint] = _CONTACT["often"]
    return contact

"""Whether a motion is one that a person could make: units, axes and frame rates that are off show here.

The checks only warn. A person may lie, and may be thrown: nothing is turned or scaled on suspicion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.load import embedded_body
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX, PARENTS
from stages.shared.poses.convert import axis_vector, y_up_from

FULL_TURN = 2 * np.pi
FASTEST = 15.0  # m/s; sprinters reach 12
FARTHEST = 200.0  # metres from the origin of a motion's world
LARGEST_TILT = 60.0  # degrees between torso and up
_TURNED_SHARE = 0.005
_TILTED_SHARE = 0.9
_TORSO = ("spine1", "spine2", "spine3", "neck", "head")


def motion_warnings(poses: Poses, axis: str, body: BodyModel | None = None) -> list[str]:
    """Sentences about what is not plausible, each with the option that would correct it.

    Arguments:
        poses: T frames, y up, metres.
        axis: axis of the file's world that was taken for up.
        body: whose torso is looked at; the embedded body without one.
    """
    return [
        *_angle_warnings(poses),
        *_speed_warnings(poses),
        *_torso_warnings(poses, axis, embedded_body() if body is None else body),
    ]


def torso_directions(poses: Poses, body: BodyModel) -> NDArray[np.float64]:
    """(T, 3) unit vectors from the pelvis to the head, world."""
    chain = [JOINT_INDEX[name] for name in _TORSO]
    turned = Rotation.from_rotvec(poses.rotations[:, 0].astype(np.float64))
    total = np.zeros((len(poses), 3))
    for joint in chain:
        total += turned.apply(body.joint_template[joint] - body.joint_template[PARENTS[joint]])
        turned = turned * Rotation.from_rotvec(poses.rotations[:, joint].astype(np.float64))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)


def _angle_warnings(poses: Poses) -> list[str]:
    angles = np.linalg.norm(poses.rotations[:, :22].astype(np.float64), axis=2)
    share = float(np.mean(angles > FULL_TURN + 1e-3))
    if share <= _TURNED_SHARE:
        return []
    return [
        f"{100 * share:.0f} % of the joint angles are beyond a full turn, the largest is "
        f"{angles.max():.0f} rad: "
        "they look like degrees. If they are, convert the file with gw poses --degrees."
    ]


def _speed_warnings(poses: Poses) -> list[str]:
    places = poses.translation.astype(np.float64)
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) * poses.fps
    fast = int((speeds > FASTEST).sum())
    distance = float(np.median(np.linalg.norm(places, axis=1)))
    if fast:
        cure = (
            "if the lengths are millimetres or centimetres, convert the file with gw poses --length-unit "
            "mm or cm"
            if np.median(speeds) > FASTEST or distance > FARTHEST
            else "the clip may be cut there, or its frame rate may be wrong (gw poses --file-fps)"
        )
        return [
            f"the root moves faster than {FASTEST:g} m/s in {fast} steps, up to {speeds.max():.0f} m/s: "
            f"{cure}."
        ]
    if distance > FARTHEST:
        return [
            f"the root is {distance:.0f} m from the origin: if the lengths are millimetres or centimetres, "
            "convert the file with gw poses --length-unit mm or cm."
        ]
    return []


def _torso_warnings(poses: Poses, axis: str, body: BodyModel) -> list[str]:
    directions = torso_directions(poses, body)
    tilted = float(np.mean(directions[:, 1] < np.cos(np.radians(LARGEST_TILT))))
    if tilted <= _TILTED_SHARE:
        return []
    in_file = directions.mean(axis=0) @ y_up_from(axis)
    candidates = ("x", "y", "z", "-x", "-y", "-z")
    best = max(candidates, key=lambda name: float(in_file @ axis_vector(name)))
    return [
        f"the torso is more than {LARGEST_TILT:g}° from upright in {100 * tilted:.0f} % of the frames, "
        f"with {axis} "
        f"of the file's world up. If the person should stand, give --up {best} to gw poses."
    ]

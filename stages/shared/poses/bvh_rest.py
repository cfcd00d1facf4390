"""The rest pose of a BVH skeleton: is it a standing person, and how does each joint differ from the body's
own.

Rotations of a BVH file are relative to the pose of zero angles. Where that pose is a T-pose, an A-pose, or
one with hanging arms, it is brought to the body's own by the directions of the limbs. Other poses, such as
those with all bones along one axis, say nothing about the twist of a bone: they are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX
from stages.shared.errors import BadData
from stages.shared.poses.bvh_file import BvhMotion
from stages.shared.poses.convert import axis_vector

Doubles = NDArray[np.float64]

# Bones whose direction in the rest pose differs between skeletons (A-pose, T-pose, spread legs).
_ALIGNED = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
_AXES = ("x", "y", "z", "-x", "-y", "-z")
_SNAPPED = 20.0  # degrees: a rest pose that is this near to facing along an axis does so
_LEG, _TORSO, _ARM, _FOOT = 50.0, 50.0, 135.0, 60.0  # largest angles in degrees, see `_check`
_STRETCHED_FOOT = 45.0  # degrees between the feet of both rest poses from which a foot is aligned


@dataclass(frozen=True, eq=False)
class RestPose:
    """The rest pose of a file.

    Attributes:
        places: (B, 3) joints, in the file's unit.
        bone_of: joint of the body to bone.
        ends: bone to the offset of its end site.
        up: axis of the file along which the person stands.
        file_from_body: (3, 3) rotation from the body's rest frame (x left, y up, z front) to the file's.
    """

    places: Doubles
    bone_of: dict[int, int]
    ends: dict[int, Doubles]
    up: str
    file_from_body: Doubles

    @classmethod
    def of(cls, motion: BvhMotion, bone_of: dict[int, int], path: Path) -> RestPose:
        """The rest pose of a skeleton. Raises BadData where it is not a standing person."""
        places = motion.rest_positions()

        def middle(name: str) -> Doubles:
            return (
                places[bone_of[JOINT_INDEX[f"left_{name}"]]] + places[bone_of[JOINT_INDEX[f"right_{name}"]]]
            ) / 2

        def across(name: str) -> Doubles:
            return (
                places[bone_of[JOINT_INDEX[f"left_{name}"]]] - places[bone_of[JOINT_INDEX[f"right_{name}"]]]
            )

        torso = middle("shoulder") - middle("hip")
        axis = max(_AXES, key=lambda name: float(torso @ axis_vector(name)))
        up = axis_vector(axis)
        left = across("shoulder") + across("hip")
        left = left - (left @ up) * up
        if not torso.any() or np.linalg.norm(left) < 1e-6 * np.linalg.norm(torso):
            raise _refusal("its shoulders are where its hips are, or left is where right is", path)
        left /= np.linalg.norm(left)
        nearest = axis_vector(max(_AXES, key=lambda name: float(left @ axis_vector(name))))
        if _degrees(left, nearest) < _SNAPPED:
            left = nearest
        rest = cls(places, bone_of, motion.ends, axis, np.stack([left, up, np.cross(left, up)], axis=1))
        rest._check(torso, path)
        return rest

    def _check(self, torso: Doubles, path: Path) -> None:
        """Torso up, legs down, arms at their own side, feet to the front; where not, the twist is not
        known.
        """
        left, up, front = self.file_from_body.T
        if _degrees(torso, up) > _TORSO:
            raise _refusal("its torso is not upright", path)
        for side in ("left", "right"):
            outwards = left if side == "left" else -left
            limbs = (
                ("hip", "ankle", -up, _LEG, "leg", "point down"),
                ("hip", "knee", -up, _LEG, "thigh", "point down"),
                ("shoulder", "elbow", outwards, _ARM, "arm", "point to its own side or down"),
                ("ankle", "foot", front, _FOOT, "foot", "point to the front"),
            )
            for start, end, direction, largest, name, right in limbs:
                bone = self._bone(side, start, end)
                if bone is None or not bone.any():
                    continue
                if name == "foot":
                    # Its slope differs between skeletons; a foot that points straight down has no heading.
                    flat = bone - (bone @ up) * up
                    if np.linalg.norm(flat) < 0.3 * np.linalg.norm(bone):
                        if bone @ up > 0:
                            raise _refusal(f"its {side} foot points up", path)
                        continue
                    bone = flat
                if _degrees(bone, direction) > largest:
                    raise _refusal(f"its {side} {name} does not {right}", path)

    def corrections(self, body: BodyModel) -> Doubles:
        """(55, 3, 3): from the body's rest orientation of a joint to the file's rest orientation."""
        joints = body.joint_template
        corrections = np.tile(self.file_from_body, (JOINT_COUNT, 1, 1))
        for side in ("left", "right"):
            for name, child in (*_ALIGNED.items(), ("ankle", "foot")):
                joint, below = JOINT_INDEX[f"{side}_{name}"], JOINT_INDEX[f"{side}_{child}"]
                theirs = self._bone(side, name, child)
                if theirs is None:
                    theirs = self.ends.get(self.bone_of[joint], np.zeros(3))
                ours = self.file_from_body @ (joints[below] - joints[joint])
                # Feet keep the file's rotation: how far the toes are below the ankle differs between
                # skeletons.
                if name == "ankle" and (not theirs.any() or _degrees(ours, theirs) < _STRETCHED_FOOT):
                    continue
                corrections[joint] = _shortest_rotation(ours, theirs) @ self.file_from_body
            corrections[JOINT_INDEX[f"{side}_foot"]] = corrections[JOINT_INDEX[f"{side}_ankle"]]
            # The hand lies in line with the forearm in both rest poses, whatever the arm's angle.
            hand = slice(25, 40) if side == "left" else slice(40, 55)
            corrections[JOINT_INDEX[f"{side}_wrist"]] = corrections[JOINT_INDEX[f"{side}_elbow"]]
            corrections[hand] = corrections[JOINT_INDEX[f"{side}_elbow"]]
        return corrections

    def _bone(self, side: str, start: str, end: str) -> Doubles | None:
        """Vector (3,) from joint to joint; None where the file lacks one."""
        first, last = (self.bone_of.get(JOINT_INDEX[f"{side}_{name}"]) for name in (start, end))
        return None if first is None or last is None else self.places[last] - self.places[first]


def _degrees(a: Doubles, b: Doubles) -> float:
    """Angle between two vectors; 180 where one has no length."""
    lengths = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(np.clip(a @ b / lengths, -1, 1)))) if lengths > 1e-12 else 180.0


def _shortest_rotation(start: Doubles, end: Doubles) -> Doubles:
    """(3, 3) that turns `start` to the direction of `end`; identity where one of them has no length."""
    lengths = np.linalg.norm(start) * np.linalg.norm(end)
    if lengths < 1e-12:
        return np.eye(3)
    axis, cosine = np.cross(start, end) / lengths, float(start @ end) / lengths
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()


def _refusal(reason: str, path: Path) -> BadData:
    return BadData(
        f"The pose of zero angles of this skeleton is not a standing person: {reason}.",
        str(path),
        "Export the motion with a T-pose or A-pose as rest pose (LAFAN1 and other files with all bones "
        "along one "
        "axis: retarget them to such a skeleton first, for example in Blender).",
    )

"""Motion of a BVH skeleton, carried over to the body model.

Bones are matched by name; each matched bone's world rotation is taken over, corrected by the rotation
between the two rest poses. Proportions stay the body's: the way of the hips is scaled by the length of the
legs, which also settles the unit of the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT, JOINT_INDEX, PARENTS, SHAPE_COUNT
from stages.shared.errors import BadData
from stages.shared.poses.bvh_file import BvhMotion, read_bvh_file
from stages.shared.poses.bvh_names import joint_of_bone

Doubles = NDArray[np.float64]

_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow")
_NEEDED = tuple(f"{side}_{name}" for side in ("left", "right") for name in _LIMBS)
# Bones whose direction in the rest pose differs between skeletons (A-pose, T-pose, spread legs).
_ALIGNED = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}


def read_bvh(path: Path, body: BodyModel | None = None) -> Poses:
    """Poses of `body` (the embedded one without) out of a BVH file.

    The result stands in a y-up world in metres: the first frame's pelvis is above the origin, the lowest foot
    of the clip on y = 0. Which axis of the file is up follows from where the shoulders are over the feet.
    Limbs point exactly where they point in the file; feet, hands and spine keep the file's rotation relative
    to the rest pose. Joints the file does not have stay as in the T-pose.

    Raises:
        BadData: not a usable BVH file, or hips, knees, ankles, shoulders or elbows are not found.
    """
    if body is None:
        from stages.shared.body.load import embedded_body

        body = embedded_body()
    motion = read_bvh_file(path)
    bone_of = joint_of_bone(motion.names, motion.parents)
    missing = [name for name in _NEEDED if JOINT_INDEX[name] not in bone_of]
    if missing:
        raise BadData(
            f"The skeleton's bones for {', '.join(missing)} are not recognised by name.",
            f"{path} (bones: {', '.join(motion.names[:40])})",
            "Rename the bones by a usual convention (CMU, HumanIK, Mixamo, Poser: LeftUpLeg, …).",
        )
    bone_rotations, bone_positions = motion.world()
    source_from_body = _source_from_body(motion, bone_of, path)
    y_up = _y_up_from_world(bone_positions, bone_of, path)
    corrections = _rest_corrections(motion, bone_of, body, source_from_body)
    world = _joint_world_rotations(bone_rotations, bone_of, corrections, y_up)
    rotations = _relative_to_parents(world)
    translation = _translation(world, bone_positions, bone_of, y_up, body, motion)
    return Poses(
        rotations.astype(np.float32),
        translation.astype(np.float32),
        np.zeros(SHAPE_COUNT, np.float32),
        np.zeros((len(world), EXPRESSION_COUNT), np.float32),
        motion.fps,
    )


def _source_from_body(motion: BvhMotion, bone_of: dict[int, int], path: Path) -> Doubles:
    """Rotation from the body's rest frame (x left, y up, z front) to the file's, snapped to its axes."""
    rest = motion.rest_positions()

    def place(name: str) -> Doubles:
        return rest[bone_of[JOINT_INDEX[name]]]

    hips = (place("left_hip") + place("right_hip")) / 2
    up = _nearest_axis((place("left_shoulder") + place("right_shoulder")) / 2 - hips)
    across = place("left_shoulder") - place("right_shoulder") + place("left_hip") - place("right_hip")
    left = _nearest_axis(across - (across @ up) * up)
    if not up.any() or not left.any():
        raise BadData(
            "The rest pose of this skeleton has no upright, two-sided shape.",
            str(path),
            "Export it in a T-pose.",
        )
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _nearest_axis(vector: Doubles) -> Doubles:
    axis = np.zeros(3)
    largest = int(np.abs(vector).argmax())
    axis[largest] = np.sign(vector[largest])
    return axis


def _y_up_from_world(positions: Doubles, bone_of: dict[int, int], path: Path) -> Doubles:
    """The rotation that brings the file's up axis, found from the motion, to +y."""
    shoulders = positions[:, [bone_of[JOINT_INDEX[f"{side}_shoulder"]] for side in ("left", "right")]].mean(
        axis=1
    )
    ankles = positions[:, [bone_of[JOINT_INDEX[f"{side}_ankle"]] for side in ("left", "right")]].mean(axis=1)
    up = _nearest_axis((shoulders - ankles).mean(axis=0))
    if not up.any():
        raise BadData("The shoulders of this skeleton are where its feet are.", str(path), "Export it again.")
    if up[1] == -1:
        return np.diag([1.0, -1.0, -1.0])
    turn = np.cross(up, [0.0, 1.0, 0.0])
    return np.round(Rotation.from_rotvec(turn * np.pi / 2).as_matrix())


def _rest_corrections(
    motion: BvhMotion, bone_of: dict[int, int], body: BodyModel, source_from_body: Doubles
) -> Doubles:
    """(55, 3, 3): from the body's rest orientation of a joint to the file's rest orientation."""
    rest, joints = motion.rest_positions(), body.joint_template
    corrections = np.tile(source_from_body, (JOINT_COUNT, 1, 1))
    for side in ("left", "right"):
        for name, child in _ALIGNED.items():
            joint, below = JOINT_INDEX[f"{side}_{name}"], JOINT_INDEX[f"{side}_{child}"]
            if below in bone_of:
                theirs = rest[bone_of[below]] - rest[bone_of[joint]]
            else:
                theirs = motion.ends.get(bone_of[joint], np.zeros(3))
            ours = source_from_body @ (joints[below] - joints[joint])
            corrections[joint] = _shortest_rotation(ours, theirs) @ source_from_body
        # The hand lies in line with the forearm in both rest poses, whatever the arm's angle.
        hand = slice(25, 40) if side == "left" else slice(40, 55)
        corrections[JOINT_INDEX[f"{side}_wrist"]] = corrections[JOINT_INDEX[f"{side}_elbow"]]
        corrections[hand] = corrections[JOINT_INDEX[f"{side}_elbow"]]
    return corrections


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


def _joint_world_rotations(
    bones: Doubles, bone_of: dict[int, int], corrections: Doubles, y_up: Doubles
) -> Doubles:
    """(T, 55, 3, 3) world rotations of our joints; joints without a bone turn with their parent."""
    world = np.zeros((len(bones), JOINT_COUNT, 3, 3))
    for joint, parent in enumerate(PARENTS):
        if joint in bone_of:
            world[:, joint] = y_up @ bones[:, bone_of[joint]] @ corrections[joint]
        else:
            world[:, joint] = world[:, parent]
    return world


def _relative_to_parents(world: Doubles) -> Doubles:
    """(T, 55, 3) axis-angle."""
    parents = np.array(PARENTS)
    local = world.copy()
    local[:, 1:] = np.swapaxes(world[:, parents[1:]], -1, -2) @ world[:, 1:]
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(world), JOINT_COUNT, 3)


def _translation(
    world: Doubles,
    bone_positions: Doubles,
    bone_of: dict[int, int],
    y_up: Doubles,
    body: BodyModel,
    motion: BvhMotion,
) -> Doubles:
    """(T, 3): the middle of the hips goes the file's way, scaled by the leg; the lowest foot is at y = 0."""
    joints = body.joint_template
    placed = np.zeros(world.shape[:2] + (3,))
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            placed[:, joint] = placed[:, parent] + world[:, parent] @ (joints[joint] - joints[parent])
    hips = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]
    theirs = bone_positions[:, [bone_of[joint] for joint in hips]].mean(axis=1) @ y_up.T
    rest = motion.rest_positions()
    scale = _leg_length(joints, {joint: joint for joint in range(JOINT_COUNT)}) / _leg_length(rest, bone_of)
    pelvis = scale * theirs - placed[:, hips].mean(axis=1)
    pelvis[:, [0, 2]] -= pelvis[0, [0, 2]]
    pelvis[:, 1] -= _lowest_sole(placed, world, pelvis, body)
    return pelvis - joints[0]


def _lowest_sole(placed: Doubles, world: Doubles, pelvis: Doubles, body: BodyModel) -> float:
    """Lowest height in the clip of any vertex that the feet carry."""
    joints = body.joint_template
    lowest = np.inf
    for name in ("left_ankle", "right_ankle", "left_foot", "right_foot"):
        joint = JOINT_INDEX[name]
        own = body.template_vertices[body.skin_weights[:, joint] > 0.5] - joints[joint]
        if not len(own):
            own = np.zeros((1, 3))
        corners = np.array([[x, y, z] for x in _ends(own, 0) for y in _ends(own, 1) for z in _ends(own, 2)])
        heights = (
            placed[:, joint, 1]
            + pelvis[:, 1]
            + (corners @ np.swapaxes(world[:, joint], -1, -2))[..., 1].min(1)
        )
        lowest = min(lowest, float(heights.min()))
    return lowest


def _ends(points: Doubles, axis: int) -> tuple[float, float]:
    return float(points[:, axis].min()), float(points[:, axis].max())


def _leg_length(places: Doubles, index: dict[int, int]) -> float:
    """Hip to knee to ankle, mean of both sides, in the unit of `places`."""
    total = 0.0
    for side in ("left", "right"):
        hip, knee, ankle = (places[index[JOINT_INDEX[f"{side}_{name}"]]] for name in ("hip", "knee", "ankle"))
        total += float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee)) / 2
    return max(total, 1e-9)

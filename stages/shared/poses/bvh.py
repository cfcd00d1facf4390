"""Motion of a BVH skeleton, carried over to the body model.

Bones are matched by name; each matched bone's world rotation is taken over, corrected by the rotation
between the two rest poses. Proportions stay the body's: the way of the hips is scaled by the length of the
legs, which also settles the unit of the file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.load import embedded_body
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import EXPRESSION_COUNT, JOINT_COUNT, JOINT_INDEX, PARENTS, SHAPE_COUNT
from stages.shared.errors import BadData
from stages.shared.poses.bvh_file import read_bvh_file
from stages.shared.poses.bvh_names import joint_of_bone
from stages.shared.poses.bvh_rest import RestPose
from stages.shared.poses.convert import y_up_from

Doubles = NDArray[np.float64]

_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow")
_NEEDED = tuple(f"{side}_{name}" for side in ("left", "right") for name in _LIMBS)


def read_bvh(
    path: Path,
    body: BodyModel | None = None,
    up: str = "auto",
    note: Callable[[str], None] = lambda text: None,
    fps: float | None = None,
) -> tuple[Poses, str]:
    """Poses of `body` (the embedded one without) out of a BVH file, and the axis of the file that is up.

    The result stands in a y-up world in metres: the first frame's pelvis is above the origin, the lowest foot
    of the clip on y = 0. Limbs point exactly where they point in the file; feet, hands and spine keep the
    file's rotation relative to the rest pose. Joints the file does not have stay as in the T-pose.

    Arguments:
        up: axis of the file's world that is up; "auto" takes the one along which the person of the rest pose
            stands. A person who lies in the whole clip keeps lying.
        note: is called with a sentence about what the file states wrongly.
        fps: frame rate that replaces the file's.

    Raises:
        BadData: not a usable BVH file; hips, knees, ankles, shoulders or elbows are not found; or a rest pose
            that is no standing person.
    """
    body = embedded_body() if body is None else body
    motion = read_bvh_file(path, note, fps)
    bone_of = joint_of_bone(motion.names, motion.parents)
    missing = [name for name in _NEEDED if JOINT_INDEX[name] not in bone_of]
    if missing:
        raise BadData(
            f"The skeleton's bones for {', '.join(missing)} are not recognised by name.",
            f"{path} (bones: {', '.join(motion.names[:40])})",
            "Rename the bones by a usual convention (CMU, HumanIK, Mixamo, Biped, Poser: LeftUpLeg, …).",
        )
    bone_rotations, bone_positions = motion.world()
    rest = RestPose.of(motion, bone_of, path)
    axis = rest.up if up == "auto" else up
    y_up = y_up_from(axis)
    corrections = rest.corrections(body)
    world = _joint_world_rotations(bone_rotations, bone_of, corrections, y_up)
    rotations = _relative_to_parents(world)
    translation = _translation(world, bone_positions, bone_of, y_up, body, rest.places)
    poses = Poses(
        rotations.astype(np.float32),
        translation.astype(np.float32),
        np.zeros(SHAPE_COUNT, np.float32),
        np.zeros((len(world), EXPRESSION_COUNT), np.float32),
        motion.fps,
    )
    return poses, axis


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
    rest: Doubles,
) -> Doubles:
    """(T, 3): the middle of the hips goes the file's way, scaled by the leg; the lowest foot is at y = 0."""
    joints = body.joint_template
    placed = np.zeros(world.shape[:2] + (3,))
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            placed[:, joint] = placed[:, parent] + world[:, parent] @ (joints[joint] - joints[parent])
    hips = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]
    theirs = bone_positions[:, [bone_of[joint] for joint in hips]].mean(axis=1) @ y_up.T
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

"""The body model: arrays, files, forward kinematics, skinning, the canonical pose, pose sequences."""

from stages.shared.body.canonical import (
    canonical_from_rest,
    canonical_poses,
    canonical_rotations,
    canonical_shape_directions,
    posed_from_canonical,
)
from stages.shared.body.kinematics import (
    blend,
    bone_transforms,
    posed_joints,
    posed_vertices,
    rigid_inverse,
    rotation_matrices,
    shaped_joints,
    shaped_vertices,
    skin,
)
from stages.shared.body.load import embedded_body, load_body
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses
from stages.shared.body.skeleton import JOINT_INDEX, JOINTS, PARENTS

__all__ = [
    "JOINTS",
    "JOINT_INDEX",
    "PARENTS",
    "BodyModel",
    "Poses",
    "blend",
    "bone_transforms",
    "canonical_from_rest",
    "canonical_poses",
    "canonical_rotations",
    "canonical_shape_directions",
    "embedded_body",
    "load_body",
    "posed_from_canonical",
    "posed_joints",
    "posed_vertices",
    "rigid_inverse",
    "rotation_matrices",
    "shaped_joints",
    "shaped_vertices",
    "skin",
]

"""People brought to the T-pose, for `make_body.py`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.kinematics import bone_transforms, skin
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX

Doubles = NDArray[np.float64]


def t_pose(vertices: Doubles, joints: Doubles, weights: Doubles) -> tuple[Doubles, Doubles]:
    """Straighten the arms along ±x by skinning, and put the pelvis joint at the origin.

    Arguments:
        vertices: (P, V, 3) m, of P people, y up, facing +z. joints: (P, 55, 3). weights: (V, 55).

    Returns:
        Vertices and joints of the same shapes.
    """
    rotations = np.zeros((len(joints), JOINT_COUNT, 3))
    for side, direction in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow, wrist, knuckle = (
            JOINT_INDEX[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist", "middle1")
        )
        turned = np.zeros((len(joints), 3))
        for joint, child in ((shoulder, elbow), (elbow, wrist), (wrist, knuckle)):
            # World rotation that lays this bone on the x axis, after what its parents have done.
            bone = _rotate(turned, joints[:, child] - joints[:, joint])
            world = _shortest_rotation(bone, np.array([direction, 0.0, 0.0]))
            rotations[:, joint] = _relative(turned, world)
            turned = _compose(world, turned)
    result, placed = [], []
    weight = torch.from_numpy(weights)
    for person in range(len(vertices)):
        rest = torch.from_numpy(joints[person])
        transforms = bone_transforms(torch.from_numpy(rotations[person]), rest)
        moved = skin(rest, torch.eye(JOINT_COUNT, dtype=torch.float64), transforms).numpy()
        result.append(skin(torch.from_numpy(vertices[person]), weight, transforms).numpy() - moved[0])
        placed.append(moved - moved[0])
    return np.stack(result), np.stack(placed)


def _shortest_rotation(vectors: Doubles, target: Doubles) -> Doubles:
    """(P, 3) axis-angle that turn `vectors` to `target` by the smallest angle."""
    unit = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = np.cross(unit, target)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (unit @ target)[:, None])
    return axis / np.maximum(sine, 1e-12) * angle


def _compose(after: Doubles, before: Doubles) -> Doubles:
    return (Rotation.from_rotvec(after) * Rotation.from_rotvec(before)).as_rotvec()


def _relative(parent: Doubles, world: Doubles) -> Doubles:
    """Local rotation of a joint whose parent is turned by `parent`, and which `world` turns further."""
    turned = Rotation.from_rotvec(parent)
    return (turned.inv() * Rotation.from_rotvec(world) * turned).as_rotvec()


def _rotate(rotations: Doubles, vectors: Doubles) -> Doubles:
    return Rotation.from_rotvec(rotations).apply(vectors)

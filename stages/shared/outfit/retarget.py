"""Retargets garments and motions to another wearer.

Garments: every body model of the SMPL-X convention has the same bones in the same canonical pose, but at
other positions, and its shape coefficients have another meaning. The points of a garment move with the
canonical positions of the bones. Its skinning weights and shape directions become those of the wearer's
nearest texels.

Motions: the path of the pelvis is scaled to the length of the legs, and the feet stay on the floor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.artifacts.bundle import Bundle
from stages.shared.body import (
    JOINT_INDEX,
    BodyModel,
    Poses,
    canonical_from_rest,
    posed_vertices,
    shaped_joints,
)
from stages.shared.body.posed import pose_tensors
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.outfit.layer import WornLayer

_NEAREST = 8
_LEAST_DISTANCE = 1e-3  # m
_SIDES = ("left", "right")
_SAMPLES = 24  # frames in which the floor is measured
Floats = NDArray[np.float32]


def canonical_joints(body: BodyModel) -> NDArray[np.float32]:
    """(55, 3) f32 m: joints of the zero shape in the canonical pose."""
    zero = torch.zeros(10)
    rest = shaped_joints(body, zero)
    transforms = canonical_from_rest(body, zero)
    placed = (transforms[:, :3, :3] @ rest[:, :, None]).squeeze(-1) + transforms[:, :3, 3]
    return placed.numpy().astype(np.float32)


def can_retarget(garment: Bundle) -> bool:
    """Whether a bundle stores the joints of the body model that it was learned with."""
    return "joints" in garment.arrays


def retarget_garment(
    garment: WornLayer, joints: NDArray[np.float32], body: WornLayer, model: BodyModel
) -> WornLayer:
    """The garment with maps for the wearer's body model; its decoder is unchanged.

    Arguments:
        joints: (55, 3) m canonical, of the body model the garment was learned with.
        body, model: the wearer's layer and body model.
    """
    maps = garment.maps
    shift = torch.from_numpy(canonical_joints(model) - joints)
    positions = maps.positions + maps.skin_weights @ shift
    distance, nearest = cKDTree(body.maps.positions.numpy()).query(positions.numpy(), k=_NEAREST)
    weights = 1 / np.maximum(distance, _LEAST_DISTANCE)
    weights = torch.from_numpy((weights / weights.sum(axis=1, keepdims=True)).astype(np.float32))
    near = torch.from_numpy(nearest)
    new = replace(
        maps,
        positions=positions,
        skin_weights=(body.maps.skin_weights[near] * weights[..., None]).sum(dim=1),
        shape_directions=(body.maps.shape_directions[near] * weights[..., None, None]).sum(dim=1),
        centre=body.maps.centre,  # each grid is centred on its body: texels then mean the same places
    )
    return replace(garment, maps=new, beneath=None, cloth=_retarget_cloth(garment.cloth, shift, body))


def _retarget_cloth(cloth: ClothPattern | None, shift: torch.Tensor, body: WornLayer) -> ClothPattern | None:
    """The simulation mesh for the wearer's body model, in the same way as the maps; its size stays.

    Arguments:
        shift: (55, 3) m, how far the canonical joints move.
    """
    if cloth is None:
        return None
    vertices = cloth.vertices + cloth.skin_weights @ shift.numpy()
    distance, nearest = cKDTree(body.maps.positions.numpy()).query(vertices, k=_NEAREST)
    weights = 1 / np.maximum(distance, _LEAST_DISTANCE)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    skin = body.maps.skin_weights.numpy()[nearest]
    directions = body.maps.shape_directions.numpy()[nearest]
    return replace(
        cloth,
        vertices=vertices.astype(np.float32),
        skin_weights=(skin * weights[..., None]).sum(axis=1),
        shape_directions=(directions * weights[..., None, None]).sum(axis=1),
    )


def fix_foot_height(poses: Poses, body: BodyModel, betas: Floats) -> Poses:
    """The motion for a wearer of shape `betas` (10,); unchanged where the motion was made for that shape.

    The path of the pelvis is scaled by the ratio of the leg lengths, about its first position on the floor.
    Then the lowest vertex of the clip gets the height it had before. The floor is assumed to be level.
    """
    if np.allclose(poses.betas, betas, atol=1e-6) or not len(poses):
        return poses
    made_for, wearer = (_rest(body, shape) for shape in (poses.betas, betas))
    ratio = _leg_length(wearer) / _leg_length(made_for)
    frames = np.unique(np.linspace(0, len(poses) - 1, _SAMPLES).round().astype(int))
    floor = _lowest(poses, body, poses.betas, frames)
    pelvis = poses.translation.astype(np.float64) + made_for[0]
    origin = pelvis[0] * [1, 0, 1] + [0, floor, 0]
    translation = origin + ratio * (pelvis - origin) - wearer[0]
    moved = replace(poses, translation=translation.astype(np.float32), betas=np.asarray(betas, np.float32))
    translation[:, 1] += floor - _lowest(moved, body, betas, frames)
    return replace(moved, translation=translation.astype(np.float32))


def _rest(body: BodyModel, betas: Floats) -> NDArray[np.float64]:
    """(55, 3) m joints at rest."""
    return shaped_joints(body, torch.from_numpy(np.asarray(betas, np.float32))).double().numpy()


def _leg_length(joints: NDArray[np.float64]) -> float:
    """Hip to knee to ankle, mean of both sides."""
    sides = [[joints[JOINT_INDEX[f"{side}_{name}"]] for name in ("hip", "knee", "ankle")] for side in _SIDES]
    return float(np.mean([np.linalg.norm(b - a) + np.linalg.norm(c - b) for a, b, c in sides]))


def _lowest(poses: Poses, body: BodyModel, betas: Floats, frames: NDArray[np.intp]) -> float:
    """Lowest height of any vertex of the body in these frames."""
    lowest = np.inf
    for frame in frames:
        vertices = posed_vertices(body, *pose_tensors(poses, int(frame), betas))
        lowest = min(lowest, float(vertices[:, 1].min()))
    return lowest

"""Retargets a garment that was learned with one body model to a wearer with another.

Every body model of the SMPL-X convention has the same bones in the same canonical pose, but at other
positions, and its shape coefficients have another meaning. The garment's points move with the canonical
positions of the bones; its skinning weights and shape directions become those of the wearer's nearest texels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.artifacts.bundle import Bundle
from stages.shared.body import BodyModel, canonical_from_rest, shaped_joints
from stages.shared.cloth.pattern import ClothPattern
from stages.shared.outfit.layer import WornLayer

_NEAREST = 8
_LEAST_DISTANCE = 1e-3  # m


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

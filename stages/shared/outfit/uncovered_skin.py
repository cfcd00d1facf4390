"""Skin that clothes covered in training and that another outfit leaves bare.

No image shows this skin. Its learned colour is arbitrary, training moved it inwards, away from the clothes,
and its Gaussians leave gaps. Where nothing covers it now, it takes the colour and the height over the
template of the skin around it (a harmonic extension of the observed skin), as discs that cover the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.deform import Attributes
from stages.shared.avatar.fabric_fill import covering_discs
from stages.shared.avatar.maps import LayerMaps
from stages.shared.losses.surface import hand_texels
from stages.shared.outfit.coverage import FEATHER, covered_weights, same_grid
from stages.shared.outfit.layer import Skin, WornLayer
from stages.shared.quaternions import slerp

_LIKE_SKIN = 0.25  # distance in sRGB from the colour of the hands; hair and shoes are farther
_LARGEST = 0.01  # m, limit of the height over the template
_PULL = 1e-3  # towards the mean, where no observed skin is connected

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class UncoveredSkin:
    """Replacement attributes of uncovered skin.

    Attributes:
        weights: (N, 1) of the body's texels, from 0 (learned) to 1 (replaced).
        offsets: (N, 3) m. colors: (N, 3) sRGB.
        quaternions: (N, 4) unit wxyz, scales: (N, 3) m, opacities: (N,) of discs that cover the surface.
    """

    weights: Tensor
    offsets: Tensor
    colors: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor

    @property
    def count(self) -> int:
        """Body texels that change."""
        return int((self.weights > 0).sum())


def extrapolate_skin(
    maps: LayerMaps, garments: Sequence[LayerMaps], offsets: Tensor, colors: Tensor
) -> Skin | None:
    """What a body bundle stores about its covered texels; None if none is covered or no skin was observed.

    Arguments:
        maps: of the body. garments: those it was learned with.
        offsets: (N, 3) m and colors: (N, 3) sRGB of the body's texels, means over poses.
    """
    covered = np.zeros(len(maps), np.float32)
    for garment in garments:
        covered = np.maximum(covered, covered_weights(maps, garment, FEATHER))
    seen = covered == 0
    hands = hand_texels(maps.skin_weights).numpy() & seen
    if not (covered > 0).any() or not hands.any():
        return None
    plain = colors.numpy()
    skin = np.median(plain[hands], axis=0)
    known = seen & (np.linalg.norm(plain - skin, axis=1) < _LIKE_SKIN)
    normals = functional.normalize(maps.normals, dim=1).numpy()
    height = np.clip(np.einsum("nk,nk->n", offsets.numpy(), normals), -_LARGEST, _LARGEST)
    values = np.concatenate([plain, height[:, None]], axis=1)
    filled = _spread(maps, values, known, seen & ~known, np.append(skin, np.median(height[known])))
    return Skin(
        torch.from_numpy(covered),
        torch.from_numpy((filled[:, 3:] * normals).astype(np.float32)),
        torch.from_numpy(np.clip(filled[:, :3], 0, 1).astype(np.float32)),
    )


def plan_uncovered_skin(body: WornLayer, garments: Sequence[WornLayer]) -> UncoveredSkin | None:
    """The skin that is bare in this outfit and was covered in training; None if there is none."""
    if body.skin is None:
        return None
    worn = np.zeros(len(body.maps), np.float32)
    for garment in garments:
        if same_grid(body.maps, garment.maps):
            worn = np.maximum(worn, covered_weights(body.maps, garment.maps, FEATHER))
    weights = torch.clamp(body.skin.covered - torch.from_numpy(worn), 0, 1)[:, None]
    if not bool((weights > 0).any()):
        return None
    return UncoveredSkin(weights, body.skin.offsets, body.skin.colors, *covering_discs(body.maps))


def replace_uncovered_skin(attributes: Attributes, uncovered_skin: UncoveredSkin | None) -> Attributes:
    """Body attributes with uncovered skin replaced."""
    if uncovered_skin is None:
        return attributes
    return replace(
        attributes,
        offsets=torch.lerp(attributes.offsets, uncovered_skin.offsets, uncovered_skin.weights),
        colors=torch.lerp(attributes.colors, uncovered_skin.colors, uncovered_skin.weights),
        quaternions=slerp(attributes.quaternions, uncovered_skin.quaternions, uncovered_skin.weights),
        scales=torch.lerp(attributes.scales, uncovered_skin.scales, uncovered_skin.weights),
        opacities=torch.lerp(attributes.opacities, uncovered_skin.opacities, uncovered_skin.weights[:, 0]),
    )


def _spread(
    maps: LayerMaps, values: Floats, known: NDArray[np.bool_], apart: NDArray[np.bool_], mean: Floats
) -> Floats:
    """(N, C) `values` where `known`; elsewhere the mean of the linked texels (a discrete harmonic field).

    Arguments:
        apart: texels that give nothing and take nothing, as shoes. mean: (C,) what is far from all known.
    """
    first, second = maps.links()
    linked = ~apart[first] & ~apart[second]
    first, second = first[linked], second[linked]
    count = len(maps)
    links = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    links = links.maximum(links.T)
    wanted = np.flatnonzero(~known & ~apart)
    degree = np.asarray(links.sum(axis=1)).ravel()[wanted]
    matrix = sparse.diags(degree + _PULL) - links[wanted][:, wanted]
    found = np.array(values, np.float32)
    given = np.flatnonzero(known)
    for channel in range(values.shape[1]):
        right = links[wanted][:, given] @ values[given, channel] + _PULL * mean[channel]
        found[wanted, channel] = cg(matrix, right, x0=np.full(len(wanted), mean[channel]), rtol=1e-5)[0]
    return found

"""Attributes of the body that an outfit replaces: the form under garments, and skin that is bare now.

Swap: a garment was learned on the body of its source and fits the surface of that body. Another body would
poke through. Under the garment, offset Δp and rotation are therefore those of the body of the source. Colour,
opacity and scale stay those of the wearer (Gaussian Wardrobe, sec. 3.4). Texels are matched by position on
the shared grid.

Uncovered skin: clothes covered it in training, so no picture shows it. Its learned colour is arbitrary, it
was moved inwards, away from the clothes, and its Gaussians leave gaps. Where nothing covers it now, it takes
the colour and the height over the template of the skin around it (a harmonic extension of the observed skin),
as discs that cover the surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.deform import Replacement
from stages.shared.avatar.fabric_fill import covering_discs
from stages.shared.avatar.maps import LayerMaps
from stages.shared.losses.surface import hand_texels
from stages.shared.outfit.coverage import FEATHER, covered_weights, same_grid
from stages.shared.outfit.layer import Skin, WornLayer

_LIKE_SKIN = 0.25  # distance in sRGB from the colour of the hands; hair and shoes are farther
_LARGEST = 0.01  # m, limit of the height over the template
_PULL = 1e-3  # towards the mean, where no observed skin is connected
Floats = NDArray[np.float32]


def plan_swap(body: WornLayer, garment: WornLayer, feather: float = FEATHER) -> Replacement | None:
    """The swap of a garment; None if both were learned together, nothing is stored, or the grids differ."""
    beneath = garment.beneath
    if beneath is None or (garment.source and garment.source == body.source):
        return None
    if not same_grid(body.maps, garment.maps):
        return None
    weights = torch.from_numpy(covered_weights(body.maps, garment.maps, feather))
    size = body.maps.grid_size
    stored = _pixel_ids(beneath.texels, size)
    place = torch.searchsorted(stored, body.maps.pixel_ids()).clamp(max=len(stored) - 1)
    known = stored[place] == body.maps.pixel_ids()
    weights = torch.where(known, weights, 0.0)
    used = weights > 0
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return Replacement(
        weights,
        torch.where(used[:, None], beneath.offsets[place], 0.0),
        torch.where(used[:, None], beneath.quaternions[place], identity),
        garment=garment.name,
    )


def covered_texels(body: LayerMaps, garment: LayerMaps) -> Tensor:
    """(K,) int64 indices of the body texels whose attributes a bundle of this garment stores."""
    return torch.from_numpy(covered_weights(body, garment, feather=0.0) > 0).nonzero()[:, 0]


def _pixel_ids(texels: Tensor, size: int) -> Tensor:
    view, row, column = texels.unbind(dim=1)
    return (view * size + row) * size + column


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
    learned = colors.numpy()
    skin = np.median(learned[hands], axis=0)
    known = seen & (np.linalg.norm(learned - skin, axis=1) < _LIKE_SKIN)
    normals = functional.normalize(maps.normals, dim=1).numpy()
    height = np.clip(np.einsum("nk,nk->n", offsets.numpy(), normals), -_LARGEST, _LARGEST)
    values = np.concatenate([learned, height[:, None]], axis=1)
    filled = _spread(maps, values, known, seen & ~known, np.append(skin, np.median(height[known])))
    return Skin(
        torch.from_numpy(covered),
        torch.from_numpy((filled[:, 3:] * normals).astype(np.float32)),
        torch.from_numpy(np.clip(filled[:, :3], 0, 1).astype(np.float32)),
    )


def plan_uncovered_skin(body: WornLayer, garments: Sequence[WornLayer]) -> Replacement | None:
    """The skin that is bare in this outfit and was covered in training; None if there is none."""
    if body.skin is None:
        return None
    worn = np.zeros(len(body.maps), np.float32)
    for garment in garments:
        if same_grid(body.maps, garment.maps):
            worn = np.maximum(worn, covered_weights(body.maps, garment.maps, FEATHER))
    weights = torch.clamp(body.skin.covered - torch.from_numpy(worn), 0, 1)
    if not bool((weights > 0).any()):
        return None
    quaternions, scales, opacities = covering_discs(body.maps)
    looks = torch.cat((body.skin.colors, scales, opacities[:, None]), dim=1)
    return Replacement(weights, body.skin.offsets, quaternions, looks)


def _spread(
    maps: LayerMaps, values: Floats, known: NDArray[np.bool_], apart: NDArray[np.bool_], mean: Floats
) -> Floats:
    """(N, C) `values` where `known`; elsewhere the mean of the linked texels (a discrete harmonic field).

    Arguments:
        apart: texels that are left out, as shoes. mean: (C,) value far from all known texels.
    """
    first, second = maps.links()
    linked = ~apart[first] & ~apart[second]
    first, second = first[linked], second[linked]
    count = len(maps)
    links = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    links = links.maximum(links.T)
    unknown, sources = np.flatnonzero(~known & ~apart), np.flatnonzero(known)
    degree = np.asarray(links.sum(axis=1)).ravel()[unknown]
    matrix = sparse.diags(degree + _PULL) - links[unknown][:, unknown]
    filled = np.array(values, np.float32)
    for channel in range(values.shape[1]):
        right = links[unknown][:, sources] @ values[sources, channel] + _PULL * mean[channel]
        filled[unknown, channel] = cg(matrix, right, x0=np.full(len(unknown), mean[channel]), rtol=1e-5)[0]
    return filled

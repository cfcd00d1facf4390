"""The body-Gaussian swap: under a garment, the wearer's body takes the shape of the garment's source.

A garment was learned on the body of its source and fits the surface of that body; another body would poke
through. Offset Δp and rotation of the covered texels are therefore those of the source's body. Colour,
opacity and scale stay the wearer's (Gaussian Wardrobe, sec. 3.4). Texels are matched by position on the
shared grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.avatar.deform import Attributes
from stages.shared.avatar.maps import LayerMaps
from stages.shared.outfit.coverage import FEATHER, covered_weights, same_grid
from stages.shared.outfit.layer import WornLayer
from stages.shared.quaternions import slerp


@dataclass(frozen=True, eq=False)
class Swap:
    """Replacement of body attributes under one garment.

    Attributes:
        garment: layer name.
        weights: (N, 1) of the body's texels, from 0 (wearer's) to 1 (source's).
        offsets: (N, 3) m. quaternions: (N, 4) unit. Zero and identity where the weight is 0.
    """

    garment: str
    weights: Tensor
    offsets: Tensor
    quaternions: Tensor

    @property
    def count(self) -> int:
        """Body texels that change."""
        return int((self.weights > 0).sum())


def plan_swap(body: WornLayer, garment: WornLayer, feather: float = FEATHER) -> Swap | None:
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
    return Swap(
        garment.name,
        weights[:, None],
        torch.where(used[:, None], beneath.offsets[place], 0.0),
        torch.where(used[:, None], beneath.quaternions[place], identity),
    )


def apply_swaps(attributes: Attributes, swaps: list[Swap]) -> Attributes:
    """Body attributes with the swaps of all garments, inner ones first."""
    for swap in swaps:
        attributes = replace(
            attributes,
            offsets=torch.lerp(attributes.offsets, swap.offsets, swap.weights),
            quaternions=slerp(attributes.quaternions, swap.quaternions, swap.weights),
        )
    return attributes


def covered_texels(body: LayerMaps, garment: LayerMaps) -> Tensor:
    """(K,) int64 indices of the body texels whose attributes a bundle of this garment stores."""
    return torch.from_numpy(covered_weights(body, garment, feather=0.0) > 0).nonzero()[:, 0]


def _pixel_ids(texels: Tensor, size: int) -> Tensor:
    view, row, column = texels.unbind(dim=1)
    return (view * size + row) * size + column

"""The body-Gaussian swap: beneath a garment, the wearer's body takes the form of the garment's own source.

A garment was learned on its source's body, so it fits that body's surface; another body would poke through.
Offset Δp and rotation of the covered texels are therefore those of the source's body; colour, opacity and
scale stay the wearer's (Gaussian Wardrobe, sec. 3.4). Texels are matched by their place on the shared grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.avatar.deform import Attributes
from stages.shared.avatar.maps import LayerMaps
from stages.shared.finite import require_finite
from stages.shared.outfit.coverage import FEATHER, covered_weights, same_grid
from stages.shared.outfit.layer import WornLayer


@dataclass(frozen=True, eq=False)
class Swap:
    """What replaces the body's form under one garment.

    Attributes:
        garment: layer name.
        weights: (N, 1) of the body's texels, 0 keep to 1 replace.
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
    """The swap that a garment brings, or None: learned together, nothing carried, or another grid."""
    beneath = garment.beneath
    if beneath is None or (garment.source and garment.source == body.source):
        return None
    if not same_grid(body.maps, garment.maps):
        return None
    weights = torch.from_numpy(covered_weights(body.maps, garment.maps, feather))
    size = body.maps.grid_size
    carried = _numbers(beneath.texels, size)
    place = torch.searchsorted(carried, body.maps.pixel_ids()).clamp(max=len(carried) - 1)
    known = carried[place] == body.maps.pixel_ids()
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


def slerp(start: Tensor, end: Tensor, weights: Tensor) -> Tensor:
    """Spherical interpolation of unit quaternions (N, 4) along the shorter arc; weights (N, 1) 0..1."""
    require_finite("slerp", start=start, end=end, weights=weights)
    cosine = (start * end).sum(dim=1, keepdim=True)
    end = torch.where(cosine < 0, -end, end)
    straight = cosine.abs() > 1 - 1e-7  # nearly equal: the chord is the arc, and the arc has no slope
    angle = torch.acos(torch.where(straight, 0.0, cosine.abs()))
    safe = torch.sin(angle)
    first = torch.where(straight, 1 - weights, torch.sin((1 - weights) * angle) / safe)
    second = torch.where(straight, weights, torch.sin(weights * angle) / safe)
    return torch.nn.functional.normalize(first * start + second * end, dim=1)


def covered_texels(body: LayerMaps, garment: LayerMaps) -> Tensor:
    """(K,) int64 indices of the body texels that a bundle of this garment must carry."""
    return torch.from_numpy(covered_weights(body, garment, feather=0.0) > 0).nonzero()[:, 0]


def _numbers(texels: Tensor, size: int) -> Tensor:
    view, row, column = texels.unbind(dim=1)
    return (view * size + row) * size + column

"""Gaussians that cover a layer's surface without gaps, from its maps alone."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.maps import LayerMaps

_COVER = 0.75  # standard deviation of a disc per distance to its neighbours; covers 98 % between them
_LONGEST = 2.0  # pitches; at the rim of a limb, longer discs would stand out from it
_FLATNESS = 0.3
_OPACITY = 0.97


def covering_discs(maps: LayerMaps) -> tuple[Tensor, Tensor, Tensor]:
    """Quaternions (N, 4), scales (N, 3) m and opacities (N,) of discs that cover the surface they lie in.

    Texels are one pitch apart on the map, and farther apart where the surface slopes away. The size of a disc
    along each axis is the distance to its neighbours along it.
    """
    import roma  # loads the whole of torch._dynamo: two seconds

    normals = functional.normalize(maps.normals, dim=1)
    down = normals.new_tensor([0.0, 0.0, 1.0]) - normals[:, 2:] * normals
    flat = down.norm(dim=1, keepdim=True) < 1e-3  # facing front or back: any direction will do
    down = functional.normalize(torch.where(flat, normals.new_tensor([1.0, 0.0, 0.0]), down), dim=1)
    across = functional.normalize(torch.linalg.cross(normals, down), dim=1)
    axes = torch.stack((torch.linalg.cross(across, normals), across, normals), dim=2)
    first, second = (torch.from_numpy(end) for end in maps.links())
    away = ((maps.positions[second] - maps.positions[first])[:, None] @ axes[first, :, :2])[:, 0].abs()
    ahead = functional.one_hot(away.argmax(dim=1), 2) * (away > 0)  # the axis that a neighbour lies on
    count = away.new_zeros(len(maps), 2).index_add(0, first, ahead.to(away))
    total = away.new_zeros(len(maps), 2).index_add(0, first, ahead * away)
    spacing = torch.where(count > 0, total / count.clamp(min=1), maps.pitch).clamp(max=_LONGEST * maps.pitch)
    thickness = _FLATNESS * spacing.min(dim=1, keepdim=True).values
    quaternions = roma.rotmat_to_unitquat(axes)[:, [3, 0, 1, 2]]
    scales = _COVER * torch.cat((spacing, thickness), dim=1)
    return quaternions, scales, torch.full_like(maps.spacing, _OPACITY)

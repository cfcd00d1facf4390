"""Surface losses: they act on the Gaussians of a layer, or on two layers that touch.

Lengths are in metres. Losses in mm² say so.
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.finite import finite, require_finite

_MM2 = 1e6  # mm² per m²
_WRISTS, _FIRST_FINGER = (20, 21), 25  # joints


def offset_loss(offsets: Tensor) -> Tensor:
    """Mean of ‖Δp‖² over Gaussians; offsets (N, 3) m, result m². No Gaussians give 0."""
    if len(offsets) == 0:
        return offsets.sum()
    return finite(offsets.square().sum(dim=1).mean(), "offset_loss", offsets=offsets)


def smooth_loss(offsets: Tensor, neighbours: Tensor) -> Tensor:
    """Mean of ‖Δp − mean of the neighbours' Δp‖² over Gaussians, in mm²: a squared graph Laplacian.

    Arguments:
        offsets: (N, 3) m. neighbours: (N, 4) int64, −1 where there is none; a texel without any counts as 0.
    """
    if len(offsets) == 0:
        return offsets.sum()
    here = (neighbours >= 0).to(offsets.dtype)[:, :, None]
    number = here.sum(dim=1)
    mean = (offsets[neighbours.clamp(min=0)] * here).sum(dim=1) / number.clamp(min=1.0)
    roughness = (offsets - mean).square().sum(dim=1) * (number[:, 0] > 0)
    return finite(roughness.mean() * _MM2, "smooth_loss", offsets=offsets)


def seam_loss(offsets: Tensor, colors: Tensor, seams: Tensor) -> Tensor:
    """Mean over seam pairs of ‖difference of Δp‖² in mm² plus ‖difference of colour‖².

    Front and back maps agree where they meet at the silhouette.

    Arguments:
        offsets: (N, 3) m. colors: (N, 3). seams: (S, 2) int64 texel pairs; no pairs give 0.
    """
    if len(seams) == 0:
        return (offsets.sum() + colors.sum()) * 0.0
    first, second = seams.unbind(dim=1)
    apart = (offsets[first] - offsets[second]).square().sum(dim=1) * _MM2
    cost = (apart + (colors[first] - colors[second]).square().sum(dim=1)).mean()
    return finite(cost, "seam_loss", offsets=offsets, colors=colors)


def opacity_loss(opacities: Tensor) -> Tensor:
    """Mean of −log α over Gaussians (N,): the body stays opaque under garments. No Gaussians give 0.

    Gaussian Wardrobe, sec. 3.4. α is clamped to at least 1e-6.
    """
    if len(opacities) == 0:
        return opacities.sum()
    require_finite("opacity_loss", opacities=opacities)
    return finite(-opacities.clamp(min=1e-6).log().mean(), "opacity_loss", opacities=opacities)


def covered_skin_loss(colors: Tensor, covered: Tensor, reference: Tensor) -> Tensor:
    """Mean of |colour − median colour of the reference texels| over covered texels.

    Skin that no picture shows takes the colour of the skin that is seen.

    Arguments:
        colors: (N, 3) of the body layer. covered, reference: (N,) bool; either empty gives 0. The reference
            colour is held fixed.
    """
    if not bool(covered.any()) or not bool(reference.any()):
        return colors.sum() * 0.0
    skin = colors[reference].detach().median(dim=0).values
    return finite((colors[covered] - skin).abs().mean(), "covered_skin_loss", colors=colors)


def hand_texels(skin_weights: Tensor) -> Tensor:
    """(N,) bool: texels whose largest skinning weight (N, 55) belongs to a wrist or a finger joint."""
    if not len(skin_weights):
        return torch.zeros(0, dtype=torch.bool)
    joint = skin_weights.argmax(dim=1)
    return (joint == _WRISTS[0]) | (joint == _WRISTS[1]) | (joint >= _FIRST_FINGER)


def nearest_inner(outer: Tensor, inner: Tensor) -> Tensor:
    """Index (N,) int64 of the inner point (M, 3) nearest to each outer point (N, 3); M must not be 0."""
    tree = cKDTree(inner.detach().cpu().numpy(), balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(outer.detach().cpu().numpy())
    return torch.from_numpy(nearest).to(outer.device)


def penetration_loss(
    outer: Tensor,
    inner: Tensor,
    inner_normals: Tensor,
    margin: float = 0.005,
    reach: float = 0.1,
    every: int = 1,
    phase: int = 0,
) -> Tensor:
    """Mean of max(ε − (p − p̄)·n̄, 0)² over outer points p: outer layers stay outside inner ones.

    Gaussian Wardrobe, sec. 3.4. p̄ is the nearest inner point and n̄ its normal. Both are held fixed, so the
    garment gives way and not the body. Points without violation count with 0.

    Arguments:
        outer: (N, 3) m. inner: (M, 3) m. inner_normals: (M, 3) unit, zero where unknown.
        margin: ε, m. reach: m, inner points farther away than this belong to another limb and do not count.
        every, phase: the mean is over the outer points phase % every, phase % every + every, and so on.
    """
    outer = outer[phase % every :: every]
    if len(outer) == 0 or len(inner) == 0:
        return outer.sum() * 0.0
    require_finite("penetration_loss", outer=outer, inner=inner, inner_normals=inner_normals)
    nearest = nearest_inner(outer, inner)
    surface, normal = inner.detach()[nearest], inner_normals.detach()[nearest]
    away = outer - surface
    height = (away * normal).sum(dim=1)
    counts = (away.detach().norm(dim=1) < reach) & (normal.square().sum(dim=1) > 0.25)
    cost = ((margin - height).clamp(min=0.0).square() * counts).mean()
    return finite(cost, "penetration_loss", outer=outer, inner=inner, inner_normals=inner_normals)

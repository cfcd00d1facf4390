"""Offsets vary smoothly over the surface: squared graph Laplacian on the map's neighbours."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite

_MM2 = 1e6


def smooth_loss(offsets: Tensor, neighbours: Tensor) -> Tensor:
    """Mean of ‖Δp − mean of the neighbours' Δp‖² over Gaussians, in mm².

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

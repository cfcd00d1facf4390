"""Gaussians stay near the template surface."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite


def offset_loss(offsets: Tensor) -> Tensor:
    """Mean of ‖Δp‖² over Gaussians; offsets (N, 3) m, result m². No Gaussians give 0."""
    if len(offsets) == 0:
        return offsets.sum()
    return finite(offsets.square().sum(dim=1).mean(), "offset_loss", offsets=offsets)

"""The body stays opaque under garments: −log α (Gaussian Wardrobe, sec. 3.4)."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite, require_finite


def opacity_loss(opacities: Tensor) -> Tensor:
    """Mean of −log α over Gaussians (N,), α clamped to at least 1e-6. No Gaussians give 0."""
    if len(opacities) == 0:
        return opacities.sum()
    require_finite("opacity_loss", opacities=opacities)
    return finite(-opacities.clamp(min=1e-6).log().mean(), "opacity_loss", opacities=opacities)

"""The body alone must fill the silhouette of the body, also where garments hide it."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite


def silhouette_loss(body_alpha: Tensor, silhouette: Tensor) -> Tensor:
    """Mean of |Ŝ_b − S_b| over pixels (H, W): the body-only render and the body's rasterised outline."""
    if body_alpha.numel() == 0:
        return body_alpha.sum()
    cost = (body_alpha - silhouette).abs().mean()
    return finite(cost, "silhouette_loss", body_alpha=body_alpha, silhouette=silhouette)

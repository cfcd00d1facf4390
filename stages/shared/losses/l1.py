"""Mean absolute difference of images."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite


def l1(image: Tensor, truth: Tensor) -> Tensor:
    """Mean of |image − truth| over pixels and channels; both (H, W, C). An empty image gives 0."""
    if image.numel() == 0:
        return image.sum()
    return finite((image - truth).abs().mean(), "l1", image=image, truth=truth)

"""Gaussians as everything passes them on, from posing to the rasteriser and to exports."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """The Gaussians of all layers in one world.

    Attributes:
        means: (N, 3) m. covariances: (N, 3, 3) m². opacities: (N,) 0..1.
        features: (N, 3 + L) sRGB, then one channel per layer, 1 for the Gaussian's own layer.
        layer_ids: (N,) int64, index into `layers`.
        layers: L names, inner to outer.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    layer_ids: Tensor
    layers: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.means)

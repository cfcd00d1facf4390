"""The method "gaussian-wardrobe": a layer for the body and one for every garment."""

from __future__ import annotations

from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.train.methods.base import Method, MethodLayers


class GaussianWardrobe(Method):
    """Layers as they were baked."""

    name = "gaussian-wardrobe"

    def layers(self, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
        return MethodLayers(maps)

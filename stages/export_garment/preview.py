"""The picture inside a bundle: the layer in the canonical pose, from the front and from the back."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.avatar.compose import compose
from stages.shared.avatar.deform import pose_layer
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.viewpoints import look_at_camera
from stages.shared.splat.gaussians import Gaussians

_PAPER = (0.96, 0.96, 0.96)


def canonical_composite(layer: WornLayer) -> Gaussians:
    """The layer's Gaussians in the canonical pose and of zero shape, in the order of its texels."""
    still = torch.eye(4).expand(55, 4, 4)
    with torch.no_grad():
        attributes = layer.model(still)
        return compose({layer.name: pose_layer(layer.maps, attributes, still, torch.zeros(10))})


def preview_picture(layer: WornLayer, size: int) -> NDArray[np.uint8]:
    """(size, size, 3) u8: front in the left half, back in the right one."""
    composite = canonical_composite(layer)
    means = composite.means.double().numpy()
    low, high = means.min(axis=0), means.max(axis=0)
    width, height, depth = (high - low).tolist()
    half = (width / 2 + 0.03, height / 2 + 0.03, depth / 2)
    views = [
        render_image(composite, look_at_camera("preview", (low + high) / 2, azimuth, half, (size // 2, size)))
        for azimuth in (0.0, np.pi)
    ]
    return np.hstack([view.on(_PAPER) for view in views])

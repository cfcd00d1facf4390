"""One image of an outfit: colour, alpha, depth and labels, and each layer alone on request."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.outfit.layer import label_of
from stages.shared.outfit.penetration import PenetrationConfig, resolve_penetration, resolve_penetration_tiles
from stages.shared.outfit.postprocess import postprocess
from stages.shared.splat.api import render_gaussians
from stages.shared.splat.gaussians import Gaussians, Rendering
from stages.shared.splat.settings import SplatSettings

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A rendering after the penetration pass and postprocessing.

    Attributes:
        color: (H, W, 3) f32 sRGB 0..1, multiplied by alpha (on black).
        alpha: (H, W) f32 0..1. depth: (H, W) f32 m along the optical axis, 0 where nothing is.
        labels: (H, W) u8 label ids, 255 where nothing is.
        layers: name to (H, W, 4) f32 colour times alpha, and alpha, of each layer rendered alone.
        repaired: (H, W) pixels that the penetration pass changed from an inner layer to a garment.
        counts: "inner/outer" to the number of such pixels.
    """

    color: Floats
    alpha: Floats
    depth: Floats
    labels: NDArray[np.uint8]
    layers: dict[str, Floats] = field(default_factory=dict)
    repaired: NDArray[np.bool_] | None = None
    counts: dict[str, int] = field(default_factory=dict)

    def on(self, background: tuple[float, float, float]) -> NDArray[np.uint8]:
        """(H, W, 3) u8 sRGB over a plain colour (0..1)."""
        behind = np.asarray(background, np.float32)
        return to_bytes(self.color + (1 - self.alpha[..., None]) * behind)

    def straight(self) -> NDArray[np.uint8]:
        """(H, W, 4) u8 as PNG wants it: colour not multiplied by alpha."""
        return to_bytes(straight_alpha(self.color, self.alpha))


def render_image(
    gaussians: Gaussians,
    camera: Camera,
    penetration: PenetrationConfig | None = None,
    each_layer: bool = False,
    backend: str = "auto",
    settings: SplatSettings = SplatSettings(),
) -> RenderedImage:
    """Render Gaussians through a camera, and postprocess the rendering.

    Arguments:
        penetration: run the penetration pass with these tolerances; None leaves it out.
        each_layer: also return every layer alone.
        settings: of the splatting.

    Raises:
        UsageProblem: cut-offs that are not possible.
    """
    layers = gaussians.layers
    with torch.no_grad():
        if not each_layer and (penetration is None or len(layers) == 1):
            rendering = render_gaussians(gaussians, camera, backend=backend, settings=settings)
            unchanged = None if penetration is None else np.zeros(tuple(rendering.alpha.shape), bool)
            return _postprocessed(rendering, layers, unchanged)
        if penetration is not None and not each_layer and _on_cpu(gaussians, backend):
            from stages.shared.splat.cpu_layers import layered_view

            view = layered_view(gaussians, camera, settings)
            resolved = resolve_penetration_tiles(view, layers, penetration)
            return _postprocessed(resolved.rendering, layers, resolved.mask, resolved.counts)
        rendering = render_gaussians(gaussians, camera, alone=layers, backend=backend, settings=settings)
        alone = {}
        if each_layer:
            alone = {
                name: np.dstack([layer.color.clamp(0, 1).numpy(), layer.alpha.numpy()])
                for name, layer in zip(layers, rendering.layers, strict=True)
            }
        if penetration is None:
            return replace(_postprocessed(rendering, layers), layers=alone)
        resolved = resolve_penetration(rendering, layers, penetration)
        image = _postprocessed(resolved.rendering, layers, resolved.mask, resolved.counts)
    return replace(image, layers=alone)


def _on_cpu(gaussians: Gaussians, backend: str) -> bool:
    """Whether the tile lists of the CPU backend can be used."""
    return backend == "cpu" or (backend == "auto" and not gaussians.means.is_cuda)


def _postprocessed(
    rendering: Rendering,
    layers: tuple[str, ...],
    repaired: NDArray[np.bool_] | None = None,
    counts: dict[str, int] | None = None,
) -> RenderedImage:
    alpha, features = rendering.alpha.numpy(), rendering.features.numpy()
    color = np.empty((*alpha.shape, 3), np.float32)
    depth, labels = np.empty(alpha.shape, np.float32), np.empty(alpha.shape, np.uint8)
    ids = np.array([label_of(name) for name in layers], np.uint8)
    postprocess(features, alpha, rendering.depth.numpy(), ids, color, depth, labels)
    return RenderedImage(color, alpha, depth, labels, repaired=repaired, counts=counts or {})


def straight_alpha(color: Floats, alpha: Floats) -> Floats:
    """(H, W, 4) colour divided by alpha (0 where there is none), and alpha."""
    covered = alpha > 1 / 512
    plain = np.where(covered[..., None], color / np.where(covered, alpha, 1)[..., None], 0)
    return np.dstack([plain, alpha]).astype(np.float32)


def to_bytes(values: Floats) -> NDArray[np.uint8]:
    """0..1 to 8 bits, rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)

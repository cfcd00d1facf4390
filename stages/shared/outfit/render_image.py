"""One picture of an outfit: colour, coverage, depth, labels, and each layer alone when asked for."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.capture.camera import Camera
from stages.shared.outfit.develop import develop
from stages.shared.outfit.layer import label_of
from stages.shared.outfit.penetration import PenetrationConfig, resolve_penetration, resolve_penetration_tiles
from stages.shared.splat.api import rasterize, rasterize_layers
from stages.shared.splat.gaussians import Gaussians
from stages.shared.splat.rendering import Rendering
from stages.shared.splat.settings import SplatSettings

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """What a camera sees.

    Attributes:
        color: (H, W, 3) f32 sRGB 0..1, multiplied by alpha (on black).
        alpha: (H, W) f32 0..1. depth: (H, W) f32 m along the optical axis, 0 where nothing is.
        labels: (H, W) u8 label ids, 255 where nothing is.
        layers: name to (H, W, 4) f32 colour times alpha, and alpha, of each layer as if it were alone.
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
    composite: Gaussians,
    camera: Camera,
    penetration: PenetrationConfig | None = None,
    each_layer: bool = False,
    backend: str = "auto",
    settings: SplatSettings = SplatSettings(),
) -> RenderedImage:
    """Render a composite through a camera.

    Arguments:
        penetration: run the penetration pass with these tolerances; None leaves the splats as they are.
        each_layer: also return every layer alone.
        settings: of the splatting.

    Raises:
        UsageProblem: cut-offs that are not possible.
    """
    view, intrinsics = camera.tensors(composite.means.device)
    gaussians = (composite.means, None, None, composite.opacities, composite.features, view, intrinsics)
    size = (camera.width, camera.height)
    with torch.no_grad():
        if not each_layer and (penetration is None or len(composite.layers) == 1):
            picture = rasterize(
                *gaussians, *size, covars=composite.covariances, backend=backend, settings=settings
            )
            nothing = None if penetration is None else np.zeros(tuple(picture.alpha.shape), bool)
            return _shot(picture, composite.layers, repaired=nothing)
        on_lists = not each_layer and _on_cpu(composite, backend)
        if on_lists and penetration is not None:
            from stages.shared.splat.cpu_layers import layered_view

            seen = layered_view(
                composite.means, composite.opacities, composite.features, view, intrinsics, *size,
                covars=composite.covariances, layer_ids=composite.layer_ids, layers=len(composite.layers),
                settings=settings,
            )  # fmt: skip
            repaired = resolve_penetration_tiles(seen, composite.layers, penetration)
            return _shot(repaired.rendering, composite.layers, {}, repaired.mask, repaired.counts)
        layered = rasterize_layers(
            *gaussians,
            *size,
            covars=composite.covariances,
            layer_ids=composite.layer_ids,
            layers=len(composite.layers),
            alone_channels=3,
            backend=backend,
            settings=settings,
        )
        alone = {}
        if each_layer:
            alone = {
                name: np.dstack([_bounded(part.features[..., :3]), part.alpha.numpy()])
                for name, part in zip(composite.layers, layered.layers, strict=True)
            }
        if penetration is None:
            return _shot(layered.composite, composite.layers, alone)
        repaired = resolve_penetration(layered, composite.layers, penetration)
    return _shot(repaired.rendering, composite.layers, alone, repaired.mask, repaired.counts)


def _on_cpu(composite: Gaussians, backend: str) -> bool:
    return backend == "cpu" or (backend == "auto" and not composite.means.is_cuda)


def _shot(
    picture: Rendering,
    layers: tuple[str, ...],
    alone: dict[str, Floats] | None = None,
    repaired: NDArray[np.bool_] | None = None,
    counts: dict[str, int] | None = None,
) -> RenderedImage:
    alpha, features = picture.alpha.numpy(), picture.features.numpy()
    color = np.empty((*alpha.shape, 3), np.float32)
    depth, labels = np.empty(alpha.shape, np.float32), np.empty(alpha.shape, np.uint8)
    ids = np.array([label_of(name) for name in layers], np.uint8)
    develop(features, alpha, picture.depth.numpy(), ids, color, depth, labels)
    return RenderedImage(color, alpha, depth, labels, alone or {}, repaired, counts or {})


def straight_alpha(color: Floats, alpha: Floats) -> Floats:
    """(H, W, 4) colour divided by alpha (0 where there is none), and alpha."""
    covered = alpha > 1 / 512
    plain = np.where(covered[..., None], color / np.where(covered, alpha, 1)[..., None], 0)
    return np.dstack([plain, alpha]).astype(np.float32)


def to_bytes(values: Floats) -> NDArray[np.uint8]:
    """0..1 to 8 bits, rounded."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _bounded(features: Tensor) -> Floats:
    return np.asarray(features.clamp(0, 1).numpy())

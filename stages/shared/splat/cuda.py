"""The CUDA backend: gsplat's kernels behind the same contract. Only this module imports gsplat.

gsplat stops, cuts and clamps by the same rules. It has no layers: each layer alone is a rasterisation of its
own.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from typing import Any

import torch
from torch import Tensor

from stages.shared.errors import MissingInput
from stages.shared.splat.rendering import Rendering
from stages.shared.splat.scene import Scene, check_gaussians


@functools.cache
def why_not() -> str | None:
    """Why this backend cannot run here, or None if it can. Cheap: imports nothing heavy without a GPU."""
    if not torch.cuda.is_available():
        return "no CUDA device"
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed"
    try:
        importlib.import_module("gsplat.rendering")
    except (ImportError, OSError, RuntimeError) as error:
        return f"gsplat does not load: {error}"
    return None


def _picture(scene: Scene, members: Tensor | None, channels: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first features, alpha, depth (B, H, W, ...) of all Gaussians, or of the chosen rows."""
    rendering: Any = importlib.import_module("gsplat.rendering")

    def pick(array: Tensor | None) -> Tensor | None:
        if array is None:
            return None
        array = array if members is None else array[members]
        return array.to("cuda", torch.float32)

    settings = scene.settings
    cameras = len(scene.viewmats)
    colors = pick(scene.colors[:, :channels])
    assert colors is not None
    pictures, alpha, _ = rendering.rasterization(
        means=pick(scene.means),
        quats=pick(scene.quats),
        scales=pick(scene.scales),
        opacities=pick(scene.opacities),
        colors=colors.expand(cameras, *colors.shape) if cameras > 1 else colors[None],
        viewmats=scene.viewmats.to("cuda", torch.float32),
        Ks=scene.Ks.to("cuda", torch.float32),
        width=scene.width,
        height=scene.height,
        near_plane=settings.near,
        far_plane=settings.far,
        eps2d=settings.eps2d,
        packed=False,
        render_mode="RGB+D",
        rasterize_mode="antialiased" if settings.antialiased else "classic",
        covars=pick(scene.covars),
    )
    features, depth = pictures[..., :-1], pictures[..., -1]
    if scene.background is not None:
        behind = scene.background[:, None, None, :channels]
        features = features + (1 - alpha) * behind.to("cuda", torch.float32)
    return features, alpha[..., 0], depth


def render_scene(scene: Scene) -> list[Rendering]:
    """The composite, then the layers alone: fields (B, H, W, ...), in the dtype of the means.

    Raises MissingInput when there is no CUDA device or no gsplat, or when the median depth is asked for.
    """
    reason = why_not()
    if reason is None and scene.median:
        reason = "it has no median depth"
    if reason is not None:
        raise MissingInput(
            f"The CUDA splatting backend cannot run: {reason}.",
            "backend",
            'Use backend="cpu", or install the extra: pip install "gaussian-wardrobe[cuda]".',
        )
    check_gaussians(scene)
    rows = [_picture(scene, None, scene.colors.shape[1])]
    ids = scene.layer_ids
    for layer in scene.alone:
        assert ids is not None
        rows.append(_picture(scene, ids == layer, scene.alone_channels))
    like = scene.means
    return [Rendering(*(field.to(like.device, like.dtype) for field in row)) for row in rows]

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
from stages.shared.splat.gaussians import Rendering
from stages.shared.splat.scene import Scene, check_gaussians
from stages.shared.splat.settings import ALPHA_MIN, TRANSMITTANCE_MIN, SplatSettings


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


def torch_projection(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, intrinsics: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """gsplat's projection in plain torch, on any device: centers (N, 2) px, conics (N, 3), depths (N,) m.

    A peer to measure against; raises MissingInput when gsplat is not installed or does not load.
    """
    try:
        plain: Any = importlib.import_module("gsplat.cuda._torch_impl")
    except (ImportError, OSError, RuntimeError, AttributeError) as error:
        problem = f"gsplat does not load: {error}"
        if importlib.util.find_spec("gsplat") is None:
            problem = "gsplat is not installed"
        raise MissingInput(problem + ".", "gsplat", "Install the extra `cuda`.") from None
    covars, _ = plain._quat_scale_to_covar_preci(quats, scales, True, False)
    _, centers, depths, conics, _ = plain._fully_fused_projection(
        means, covars, viewmat[None], intrinsics[None], width, height
    )
    return centers[0], conics[0], depths[0]


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


def _usual(settings: SplatSettings) -> bool:
    cuts = (settings.alpha_min, settings.transmittance_min)
    return cuts == (ALPHA_MIN, TRANSMITTANCE_MIN) and settings.precision == "single"


def render_scene(scene: Scene) -> list[Rendering]:
    """The composite, then the layers alone: fields (B, H, W, ...), in the dtype of the means.

    Raises MissingInput when there is no CUDA device or no gsplat, or when it lacks an option asked for.
    """
    reason = why_not()
    if reason is None and scene.settings.median_depth:
        reason = "it has no median depth"
    if reason is None and not _usual(scene.settings):
        reason = "its cut-offs and its precision are fixed"
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
    moved = [[field.to(like.device, like.dtype) for field in row] for row in rows]
    return [Rendering(features, alpha, depth) for features, alpha, depth in moved]

"""Differentiable rendering of 3D Gaussians: the one entry, whatever the machine.

    picture = rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height)
    picture.features, picture.alpha, picture.depth

Argument names are those of gsplat. Backends: `reference` (plain torch, any float type, slow, the oracle),
`cpu` (fast, float32 unless `precision` says otherwise), `cuda` (gsplat). `auto` is `cuda` for tensors on a
GPU, else `cpu`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.splat.gaussians import Gaussians, Rendering
from stages.shared.splat.scene import Scene, make_scene
from stages.shared.splat.settings import SplatSettings

BACKENDS = ("auto", "reference", "cpu", "cuda")


def rasterize(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    covars: Tensor | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
    settings: SplatSettings = SplatSettings(),
) -> Rendering:
    """Render Gaussians as seen by one camera or by B.

    Arguments:
        means: (N, 3) centres, m, world.
        quats, scales: (N, 4) wxyz of any length but zero, (N, 3) m; or None and `covars`.
        opacities: (N,) in [0, 1].
        colors: (N, C) features, any C: colours, one-hot labels, anything linear.
        viewmats: (4, 4) or (B, 4, 4) camera_from_world, OpenCV axes (x right, y down, z forward).
        Ks: (3, 3) or (B, 3, 3) px; pixel (row r, column c) has its centre at (c + 0.5, r + 0.5). Both may be
            float64 (`Camera.tensors`): the CPU projects in float64 whatever the type of the Gaussians.
        width, height: px.
        covars: (N, 3, 3) m^2, world.
        background: (C,) or (B, C), behind everything; none is black.
        settings: near and far plane, blur, cut-offs, precision, median depth.

    The rules are those of 3DGS: 0.3 px^2 blur, alpha below 1/255 left out, alpha at most 0.999, a pixel stops
    before its transmittance falls to 1e-4; Gaussians of equal float32 depth keep their order.

    Gradients reach means, quats, scales, covars, opacities, colors, background, viewmats and Ks. Second
    derivatives are refused.

    Raises UsageProblem (shapes, names) and BadData (numbers), naming array and index.
    """
    scene = make_scene(
        means, quats, scales, covars, opacities, colors, viewmats, Ks, background, width, height,
        None, 0, (), 0, settings,
    )  # fmt: skip
    return _pictures(_backend(backend, scene)(scene), viewmats.ndim == 3)[0]


def rasterize_layers(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    layer_ids: Tensor,
    layers: int,
    alone: Sequence[int] | None = None,
    alone_channels: int | None = None,
    covars: Tensor | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
    settings: SplatSettings = SplatSettings(),
) -> Rendering:
    """Render all layers together, and layers as if the others were not there, in one traversal.

    One projection, one sort and one walk over the Gaussians; a layer that is not asked for costs nothing.

    Arguments:
        layer_ids: (N,) integers in [0, layers).
        alone: the layers to render alone, each at most once; all of them when None.
        alone_channels: how many of the first features the layers alone have; all when None, 0 for alpha and
            depth only.

    Everything else as in `rasterize`; the background is behind the composite and behind every layer. The
    result's `layers` are in the order of `alone`.
    """
    if layers < 1:
        raise UsageProblem(f"layers is {layers}.", "layers", "Ask for one layer at least.")
    scene = make_scene(
        means, quats, scales, covars, opacities, colors, viewmats, Ks, background, width, height,
        layer_ids, layers, alone, alone_channels, settings,
    )  # fmt: skip
    composite, *layers_alone = _pictures(_backend(backend, scene)(scene), viewmats.ndim == 3)
    return replace(composite, layers=tuple(layers_alone))


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    *,
    alone: Sequence[str] = (),
    alone_channels: int = 3,
    backend: str = "auto",
    settings: SplatSettings = SplatSettings(),
) -> Rendering:
    """Render Gaussians as a camera sees them, on black.

    Arguments:
        alone: names of layers that are also rendered alone; the result's `layers` are in this order.
        alone_channels: as in `rasterize_layers`.
    """
    arrays = (gaussians.means, None, None, gaussians.opacities, gaussians.features)
    view = (*camera.tensors(gaussians.means.device), camera.width, camera.height)
    options: dict[str, Any] = {"covars": gaussians.covariances, "backend": backend, "settings": settings}
    if not alone:
        return rasterize(*arrays, *view, **options)
    return rasterize_layers(
        *arrays,
        *view,
        layer_ids=gaussians.layer_ids,
        layers=len(gaussians.layers),
        alone=[gaussians.layers.index(name) for name in alone],
        alone_channels=alone_channels,
        **options,
    )


def contributions(gaussians: Gaussians, camera: Camera) -> Tensor:
    """(N,) sum over pixels of each Gaussian's blending weight: 0 where it is hidden or out of sight.

    For culling and debugging. No gradient.
    """
    with torch.enable_grad():
        # A Gaussian's weights are what its colour is multiplied with: the gradient of the summed picture.
        ones = torch.ones_like(gaussians.opacities)[:, None].detach().requires_grad_()
        means, covars, opacities = (
            tensor.detach() for tensor in (gaussians.means, gaussians.covariances, gaussians.opacities)
        )
        view = (*camera.tensors(means.device), camera.width, camera.height)
        picture = rasterize(means, None, None, opacities, ones, *view, covars=covars)
        if not picture.features.requires_grad:  # nothing is in view
            return torch.zeros_like(opacities)
        (weights,) = torch.autograd.grad(picture.features.sum(), ones)
    return weights[:, 0]


def _pictures(pictures: list[Rendering], batched: bool) -> list[Rendering]:
    """Fields (B, H, W, ...), without the camera axis when one camera was given."""
    if batched:
        return pictures
    return [
        Rendering(
            picture.features.squeeze(0),
            picture.alpha.squeeze(0),
            picture.depth.squeeze(0),
            None if picture.median_depth is None else picture.median_depth.squeeze(0),
        )
        for picture in pictures
    ]


def _backend(name: str, scene: Scene) -> Callable[[Scene], list[Rendering]]:
    """The function of a backend; imported when asked for, since each brings a heavy library."""
    if name not in BACKENDS:
        raise UsageProblem(
            f"There is no splatting backend {name!r}.", "backend", "Use " + ", ".join(BACKENDS) + "."
        )
    if name == "auto":
        name = "cuda" if scene.means.is_cuda else "cpu"
    if name == "reference":
        from stages.shared.splat.reference import render_scene

        return render_scene
    if name == "cuda":
        from stages.shared.splat import cuda

        return cuda.render_scene
    from stages.shared.splat import cpu

    return cpu.render_scene

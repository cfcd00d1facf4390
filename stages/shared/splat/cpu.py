"""The CPU backend: compiled vector kernels over tiles, float32 (or float64) pictures, float64 projection.

The steps are those of `cpu_steps.py`. The same bytes come out whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.report import SILENT, Report
from stages.shared.splat.cpu_steps import (
    FlatGaussians,
    PixelBuffers,
    RefusedGaussians,
    Sizes,
    arrange,
    blend_view,
    camera_numbers,
    view_backward,
)
from stages.shared.splat.gaussians import Rendering
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.compiling import announce_to
from stages.shared.splat.kernels.project_backward import LARGEST
from stages.shared.splat.scene import Scene, check_gaussians
from stages.shared.splat.settings import SplatSettings


class _OnceOnly(torch.autograd.Function):
    """Returns the first `count` tensors, which depend on the rest; refuses to differentiate them."""

    @staticmethod
    def forward(ctx: Any, count: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(None if x is None else x.view_as(x) for x in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise RuntimeError("Splatting has no second derivatives: call backward without create_graph.")


class _Rasterize(torch.autograd.Function):
    """Pictures with a leading axis of cameras, see `PixelBuffers`, and the median depth.

    Gaussians and background are in the type of the pictures, cameras in float64.
    """

    @staticmethod
    def forward(
        ctx: Any,
        sizes: Sizes,
        layer_slots: Tensor | None,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        background: Tensor | None,
    ) -> tuple[Tensor, ...]:
        inputs = (means, quats, scales, covars, opacities, colors, layer_slots)
        gaussians = _gaussians(inputs)
        cameras, others, place = len(viewmats), sizes.alone or 0, (sizes.height, sizes.width)
        features = means.new_empty(cameras, *place, sizes.channels)
        alone_features = means.new_empty(cameras, others, *place, sizes.alone_channels)
        alpha, depth = (means.new_empty(cameras, 1 + others, *place) for _ in range(2))
        pictures = (features, alone_features, alpha, depth)
        median = means.new_empty(alpha.shape if sizes.settings.median_depth else 0)
        behind = means.new_zeros(cameras, sizes.channels) if background is None else background.contiguous()
        views = []
        for i in range(cameras):
            camera = camera_numbers(viewmats[i].numpy(), Ks[i].numpy(), sizes)
            view = arrange(gaussians, camera, behind[i].numpy(), sizes)
            median_of_view = median[i].numpy() if sizes.settings.median_depth else None
            blend_view(view, PixelBuffers.of(pictures, i), median_of_view, sizes)
            views.append(view)
        if any(ctx.needs_input_grad):
            ctx.sizes, ctx.views = sizes, views
            ctx.save_for_backward(*inputs, *pictures)
        ctx.mark_non_differentiable(median)
        return *pictures, median

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            gradients = _Rasterize._backward(ctx, grads)
        if not torch.is_grad_enabled():
            return gradients
        inputs = ctx.saved_tensors[:6]
        return (None, None, *_OnceOnly.apply(len(gradients) - 2, *gradients[2:], *grads, *inputs))

    @staticmethod
    def _backward(ctx: Any, grads: tuple[Tensor, ...]) -> tuple[Tensor | None, ...]:
        sizes, views = ctx.sizes, ctx.views
        inputs, pictures = ctx.saved_tensors[:-4], ctx.saved_tensors[-4:]
        gaussians = _gaussians(inputs)
        incoming = [x.contiguous() for x in grads[:4]]
        outgoing = [None if x is None else torch.empty(x.shape, dtype=x.dtype) for x in inputs[:6]]
        arrays = [None if x is None else x.numpy().reshape(-1) for x in outgoing]
        g_viewmats, g_Ks = (torch.zeros(len(views), side, side, dtype=torch.float64) for side in (4, 3))
        for i, view in enumerate(views):
            images, upstream = PixelBuffers.of(pictures, i), PixelBuffers.of(incoming, i)
            numbers = view_backward(gaussians, view, images, upstream, arrays, i > 0, sizes)
            g_camera = torch.from_numpy(numbers.clip(-LARGEST, LARGEST)).to(g_Ks)
            g_viewmats[i, :3, :3], g_viewmats[i, :3, 3] = g_camera[:9].reshape(3, 3), g_camera[9:12]
            g_Ks[i, [0, 1, 0, 1], [0, 1, 2, 2]] = g_camera[12:]
        g_background = None
        if ctx.needs_input_grad[10]:
            # numpy's plain sum: one thread, so that its order is fixed.
            through = 1 - pictures[2].numpy()
            sums = np.einsum("bhwc,bhw->bc", incoming[0].numpy(), through[:, 0])
            sums[:, : sizes.alone_channels] += np.einsum(
                "bahwc,bahw->bc", incoming[1].numpy(), through[:, 1:]
            )
            g_background = torch.from_numpy(sums)
        return (None, None, *outgoing, g_viewmats, g_Ks, g_background)


def _gaussians(inputs: Iterable[Tensor | None]) -> FlatGaussians:
    arrays: list[Any] = [None if x is None else x.detach().contiguous().numpy().reshape(-1) for x in inputs]
    return FlatGaussians(*arrays)


def _layer_slots(scene: Scene) -> Tensor | None:
    """(N,) int32: the picture of each Gaussian's layer, from 1 on; 0 if that is not rendered alone."""
    if scene.layer_ids is None or not scene.alone:
        return None
    pictures = torch.zeros(scene.layers, dtype=torch.int32)
    pictures[list(scene.alone)] = torch.arange(1, len(scene.alone) + 1, dtype=torch.int32)
    return pictures[scene.layer_ids]


def render_scene(scene: Scene) -> list[Rendering]:
    """The composite, then the layers alone: fields (B, H, W, ...), in the dtype of the means."""
    others = len(scene.alone) or None
    sizes = Sizes(
        scene.width, scene.height, scene.colors.shape[1], others, scene.alone_channels,
        scene.settings, layout.host_lanes(scene.settings.precision),
    )  # fmt: skip
    kind = torch.float64 if scene.settings.precision == "double" else torch.float32
    gaussians = (scene.means, scene.quats, scene.scales, scene.covars, scene.opacities, scene.colors)
    arrays = [None if x is None else x.to(kind) for x in gaussians]
    background = None if scene.background is None else scene.background.to(kind)
    cameras = (scene.viewmats.double(), scene.Ks.double())
    try:
        pictures = _Rasterize.apply(sizes, _layer_slots(scene), *arrays, *cameras, background)
    except RefusedGaussians:
        check_gaussians(scene)
        raise
    features, alone, alpha, depth, median = (x.to(scene.means.dtype) for x in pictures)
    # Axes are taken apart, not indexed: the backward of an index would fill and add whole pictures of zeros.
    medians = median.unbind(1) if scene.settings.median_depth else [None] * (1 + len(scene.alone))
    rows = zip((features, *alone.unbind(1)), alpha.unbind(1), depth.unbind(1), medians, strict=True)
    return [Rendering(*row) for row in rows]


def warm_up(
    report: Report = SILENT, channels: tuple[int, ...] = (3,), alone_channels: int | None = None
) -> None:
    """Have the kernels for these channel counts ready, compiled or read from disk; says so when compiling.

    alone_channels: of layers rendered alone; None for `rasterize`.
    """
    layered = alone_channels is not None
    with announce_to(report.say):
        for count in channels:
            sizes = Sizes(
                16, 16, count, 1 if layered else None, alone_channels or 0, SplatSettings(),
                layout.host_lanes(),
            )  # fmt: skip
            own = torch.ones(1, dtype=torch.int32) if layered else None
            mean, camera = torch.tensor([[0.0, 0.0, 2.0]]), torch.eye(4).double()[None]
            intrinsics = torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]).double()
            turned, scale = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
            for shape in ((turned, scale, None), (None, None, torch.eye(3)[None] * 0.01)):
                colors = torch.ones(1, count, requires_grad=True)
                arguments = (mean, *shape, torch.ones(1), colors, camera, intrinsics, None)
                with torch.enable_grad():
                    _Rasterize.apply(sizes, own, *arguments)[2].sum().backward()

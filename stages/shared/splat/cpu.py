"""The CPU backend: compiled vector kernels over tiles, float32 (or float64) pictures, float64 projection.

Forward: project -> sort by depth -> sort into tiles -> blend. Backward: blend again, front to back, into one
slot per (tile, Gaussian) -> sum each Gaussian's slots in order -> backward of the projection. The same bytes
come out whatever the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.errors import BadData
from stages.shared.report import SILENT, Report
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.blend import blend, median_depths
from stages.shared.splat.kernels.blend_backward import blend_backward
from stages.shared.splat.kernels.compiling import told_to
from stages.shared.splat.kernels.order import count_tiles, depth_order, fill_tiles, place_tiles
from stages.shared.splat.kernels.project import project
from stages.shared.splat.kernels.project_backward import CAMERA_GRADIENTS, LARGEST, project_backward
from stages.shared.splat.kernels.threads import run_alone, run_together
from stages.shared.splat.rendering import Rendering
from stages.shared.splat.scene import Scene, check_gaussians
from stages.shared.splat.settings import FRUSTUM_MARGIN, SplatSettings


class RefusedGaussians(Exception):
    """Projection met numbers that cannot be rendered."""


_MOST_ENTRIES = 1 << 28


@dataclass(frozen=True)
class Sizes:
    """Everything about a call that is not an array."""

    width: int
    height: int
    channels: int
    alone: int | None  # layers rendered alone, beside the composite
    alone_channels: int
    median: bool
    settings: SplatSettings
    lanes: int

    @property
    def specialised(self) -> bool:
        return self.channels in layout.SPECIALISED_CHANNELS

    @property
    def kind(self) -> np.dtype:
        return layout.element_type(self.settings)

    @property
    def columns(self) -> int:
        return -(-self.width // layout.TILE)

    @property
    def tiles(self) -> int:
        return self.columns * -(-self.height // layout.TILE)

    @property
    def record(self) -> int:
        return layout.record_length(self.channels)

    @property
    def slot(self) -> int:
        return layout.slot_length(self.channels, self.lanes)

    def argument(self, size: int) -> tuple[int, ...] | int:
        """A size that kernels are compiled for, or one they are told."""
        return layout.size_argument(size, self.specialised)

    def kernel_sizes(self, own_pictures: np.ndarray | None) -> tuple[Any, ...]:
        """The arguments width ... lanes of the blending kernels."""
        lanes, constants = layout.lanes_argument(self.lanes), layout.constants(self.lanes, self.settings)
        return self.width, self.height, own_pictures, self.alone, constants, lanes


@dataclass(frozen=True)
class Gaussians:
    """The inputs as flat arrays; own_pictures int32: from 1 on, 0 where only the composite counts."""

    means: np.ndarray  # (3N,)
    quats: np.ndarray | None  # (4N,)
    scales: np.ndarray | None  # (3N,)
    covars: np.ndarray | None  # (9N,)
    opacities: np.ndarray  # (N,)
    colors: np.ndarray  # (C N,)
    own_pictures: np.ndarray | None = None  # (N,)

    @property
    def placed(self) -> tuple[Any, ...]:
        """What projection reads."""
        return self.means, self.quats, self.scales, self.covars, self.opacities


@dataclass(frozen=True)
class View:
    """What one camera saw: kept for the backward pass."""

    camera: np.ndarray  # (25,) see kernels/geometry.py
    background: np.ndarray  # (C,)
    records: np.ndarray  # (N * record,)
    counts: np.ndarray  # (N,) tiles per Gaussian
    first_slots: np.ndarray  # (N + 1,)
    starts: np.ndarray  # (tiles + 1,)
    gaussians: np.ndarray  # (E,) tile lists: rows
    slots: np.ndarray  # (E,) and where the gradient of each entry goes, Gaussian by Gaussian
    blocks: np.ndarray  # (E,) blocks of the tile in which each entry changed the composite
    own_blocks: np.ndarray  # (E,) and its own layer's picture; empty without layers
    own_pictures: np.ndarray | None  # (N,)


@dataclass(frozen=True)
class Pictures:
    """Of one camera, or their gradients: the composite's features, those of the layers alone, and of all."""

    features: np.ndarray  # (H, W, C)
    alone_features: np.ndarray  # (A, H, W, C')
    alpha: np.ndarray  # (1 + A, H, W)
    depth: np.ndarray  # (1 + A, H, W)

    @classmethod
    def of(cls, tensors: Iterable[Tensor], camera: int) -> Pictures:
        return cls(*(tensor[camera].numpy() for tensor in tensors))

    @property
    def flat(self) -> tuple[np.ndarray, ...]:
        return tuple(x.reshape(-1) for x in vars(self).values())


def camera_numbers(viewmat: np.ndarray, intrinsics: np.ndarray, sizes: Sizes) -> np.ndarray:
    """One camera as the 25 doubles that the projection reads."""
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * sizes.width / fx, FRUSTUM_MARGIN * 0.5 * sizes.height / fy
    left, right = -cx / fx - margin_x, (sizes.width - cx) / fx + margin_x
    top, bottom = -cy / fy - margin_y, (sizes.height - cy) / fy + margin_y
    options = sizes.settings
    cut = math.log2(options.alpha_min)
    tail = (options.near, options.far, options.eps2d, float(options.antialiased), cut)
    axes = (*viewmat[:3, :3].ravel(), *viewmat[:3, 3])
    return np.array([*axes, fx, fy, cx, cy, left, right, top, bottom, *tail], np.float64)


def _whole_lines(count: int, sizes: Sizes) -> np.ndarray:
    """Uninitialised numbers that begin at a cache line: records and slots are whole lines."""
    room = np.empty(count + 16, sizes.kind)
    skip = -(room.ctypes.data // room.itemsize) % (64 // room.itemsize)
    return room[skip : skip + count]


def arrange(gaussians: Gaussians, camera: np.ndarray, background: np.ndarray, sizes: Sizes) -> View:
    """Project, sort by depth, sort into tiles."""
    n = len(gaussians.opacities)
    records, boxes = _whole_lines(n * sizes.record, sizes), np.empty(4 * n, np.uint16)
    depths, counts = np.empty(n, np.float32), np.empty(n, np.int32)
    run_together(
        project, *gaussians.placed, gaussians.colors, sizes.channels, camera,
        float(sizes.width), float(sizes.height), records, sizes.record, boxes, depths, counts,
    )  # fmt: skip
    first_slots = np.empty(n + 1, np.int32)
    order, entries = run_alone(depth_order, depths.view(np.uint32), counts, first_slots)
    if entries < 0:
        raise RefusedGaussians
    if entries > _MOST_ENTRIES:
        raise BadData(
            f"The Gaussians cover {entries:.3g} tiles in all, more than {_MOST_ENTRIES:.3g}.",
            "scales, Ks",
            "Look for scales in the wrong unit, or render a smaller picture.",
        )
    tallies = np.zeros((max(torch.get_num_threads(), 1), sizes.tiles), np.int32)
    starts = np.empty(sizes.tiles + 1, np.int64)
    run_together(count_tiles, order, boxes, sizes.columns, tallies)
    run_alone(place_tiles, tallies, starts)
    rows, slots = (np.empty(entries, np.int32) for _ in range(2))
    blocks, own_blocks = (np.empty(size, np.uint32) for size in (entries, entries if sizes.alone else 0))
    run_together(fill_tiles, order, boxes, first_slots, sizes.columns, tallies, rows, slots)
    return View(
        camera, background, records, counts, first_slots, starts, rows, slots, blocks, own_blocks,
        gaussians.own_pictures,
    )  # fmt: skip


def blend_view(view: View, pictures: Pictures, median: np.ndarray | None, sizes: Sizes) -> None:
    """Fill the pictures of one camera; `median` is (1 + A, H, W)."""
    lists, blocks = (view.starts, view.gaussians), (view.blocks, view.own_blocks)
    run_together(
        blend, *lists, view.records, sizes.record, view.background, *pictures.flat, *blocks,
        *sizes.kernel_sizes(view.own_pictures), sizes.argument(2 + sizes.channels),
        sizes.argument(2 + sizes.alone_channels),
    )  # fmt: skip
    if median is not None:
        run_together(
            median_depths, *lists, *blocks, view.records, sizes.record, median.reshape(-1),
            *sizes.kernel_sizes(view.own_pictures),
        )  # fmt: skip


def view_backward(
    gaussians: Gaussians,
    view: View,
    pictures: Pictures,
    incoming: Pictures,
    outgoing: list[np.ndarray | None],
    add: bool,
    sizes: Sizes,
) -> np.ndarray:
    """Write (or add) the gradients of one camera's pictures to `outgoing`; return the camera's own (16,)."""
    lanes, slot = layout.lanes_argument(sizes.lanes), sizes.argument(sizes.slot)
    sums = _whole_lines(len(view.gaussians) * sizes.slot, sizes)
    run_together(
        blend_backward, view.starts, view.gaussians, view.slots, view.records, sizes.record, view.background,
        *pictures.flat, view.blocks, view.own_blocks, *incoming.flat, sums,
        *sizes.kernel_sizes(view.own_pictures), sizes.argument(sizes.channels), slot,
        sizes.argument(sizes.alone_channels),
    )  # fmt: skip
    turns = -(-len(gaussians.opacities) // (layout.GROUP * layout.GROUPS_PER_TURN))
    shares = np.empty(turns * CAMERA_GRADIENTS, np.float64)
    seen = (view.camera, view.counts, view.first_slots)
    run_together(
        project_backward, *gaussians.placed, *seen, sums, lanes, slot, sizes.channels, add,
        *outgoing, shares,
    )  # fmt: skip
    return shares.reshape(turns, CAMERA_GRADIENTS).sum(0)


class _OnceOnly(torch.autograd.Function):
    """Hands the first `count` tensors on; what they came from follows. Differentiating them is refused."""

    @staticmethod
    def forward(ctx: Any, count: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(None if x is None else x.view_as(x) for x in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise RuntimeError("Splatting has no second derivatives: call backward without create_graph.")


class _Rasterize(torch.autograd.Function):
    """Pictures with a leading axis of cameras, see `Pictures`, and the median depth; inputs in that type."""

    @staticmethod
    def forward(
        ctx: Any,
        sizes: Sizes,
        own_pictures: Tensor | None,
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
        inputs = (means, quats, scales, covars, opacities, colors, own_pictures)
        gaussians = _gaussians(inputs)
        cameras, others, place = len(viewmats), sizes.alone or 0, (sizes.height, sizes.width)
        features = means.new_empty(cameras, *place, sizes.channels)
        alone_features = means.new_empty(cameras, others, *place, sizes.alone_channels)
        alpha, depth = (means.new_empty(cameras, 1 + others, *place) for _ in range(2))
        pictures = (features, alone_features, alpha, depth)
        median = means.new_empty(alpha.shape if sizes.median else 0)
        behind = means.new_zeros(cameras, sizes.channels) if background is None else background.contiguous()
        views = []
        for i in range(cameras):
            camera = camera_numbers(viewmats[i].double().numpy(), Ks[i].double().numpy(), sizes)
            view = arrange(gaussians, camera, behind[i].numpy(), sizes)
            blend_view(view, Pictures.of(pictures, i), median[i].numpy() if sizes.median else None, sizes)
            views.append(view)
        if any(ctx.needs_input_grad):
            ctx.sizes, ctx.views = sizes, views
            ctx.save_for_backward(*inputs, *pictures)
        ctx.mark_non_differentiable(median)
        return *pictures, median

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            found = _Rasterize._backward(ctx, grads)
        if not torch.is_grad_enabled():
            return found
        return (None, None, *_OnceOnly.apply(len(found) - 2, *found[2:], *grads, *ctx.saved_tensors[:6]))

    @staticmethod
    def _backward(ctx: Any, grads: tuple[Tensor, ...]) -> tuple[Tensor | None, ...]:
        sizes, views = ctx.sizes, ctx.views
        inputs, pictures = ctx.saved_tensors[:-4], ctx.saved_tensors[-4:]
        gaussians = _gaussians(inputs)
        incoming = [x.contiguous() for x in grads[:4]]
        outgoing = [None if x is None else torch.empty(x.shape, dtype=x.dtype) for x in inputs[:6]]
        arrays = [None if x is None else x.numpy().reshape(-1) for x in outgoing]
        g_viewmats, g_Ks = (inputs[0].new_zeros(len(views), side, side) for side in (4, 3))
        for i, view in enumerate(views):
            seen, wanted = Pictures.of(pictures, i), Pictures.of(incoming, i)
            numbers = view_backward(gaussians, view, seen, wanted, arrays, i > 0, sizes)
            g_camera = torch.from_numpy(numbers.clip(-LARGEST, LARGEST)).to(g_Ks)
            g_viewmats[i, :3, :3], g_viewmats[i, :3, 3] = g_camera[:9].reshape(3, 3), g_camera[9:12]
            g_Ks[i, [0, 1, 0, 1], [0, 1, 2, 2]] = g_camera[12:]
        g_background = None
        if ctx.needs_input_grad[10]:
            # numpy's plain sum: one thread, so that its order is fixed.
            through = 1 - pictures[2].numpy()
            found = np.einsum("bhwc,bhw->bc", incoming[0].numpy(), through[:, 0])
            found[:, : sizes.alone_channels] += np.einsum(
                "bahwc,bahw->bc", incoming[1].numpy(), through[:, 1:]
            )
            g_background = torch.from_numpy(found)
        return (None, None, *outgoing, g_viewmats, g_Ks, g_background)


def _gaussians(inputs: Iterable[Tensor | None]) -> Gaussians:
    arrays: list[Any] = [None if x is None else x.detach().contiguous().numpy().reshape(-1) for x in inputs]
    return Gaussians(*arrays)


def _own_pictures(scene: Scene) -> Tensor | None:
    """(N,) int32: the picture of each Gaussian's layer, from 1 on; 0 where its layer is not asked for."""
    if scene.layer_ids is None or not scene.alone:
        return None
    pictures = torch.zeros(scene.layers, dtype=torch.int32)
    pictures[list(scene.alone)] = torch.arange(1, len(scene.alone) + 1, dtype=torch.int32)
    return pictures[scene.layer_ids]


def render_scene(scene: Scene) -> list[Rendering]:
    """The composite, then the layers alone: fields (B, H, W, ...), in the dtype of the means."""
    others = len(scene.alone) or None
    sizes = Sizes(
        scene.width, scene.height, scene.colors.shape[1], others, scene.alone_channels, scene.median,
        scene.settings, layout.host_lanes(scene.settings.precision),
    )  # fmt: skip
    inputs = (
        scene.means, scene.quats, scene.scales, scene.covars, scene.opacities, scene.colors, scene.viewmats,
        scene.Ks, scene.background,
    )  # fmt: skip
    kind = torch.float64 if scene.settings.precision == "double" else torch.float32
    exact = [None if x is None else x.to(kind) for x in inputs]
    try:
        pictures = _Rasterize.apply(sizes, _own_pictures(scene), *exact)
    except RefusedGaussians:
        check_gaussians(scene)
        raise
    features, alone, alpha, depth, median = (x.to(scene.means.dtype) for x in pictures)
    # Axes are taken apart, not indexed: the backward of an index would fill and add whole pictures of zeros.
    medians = median.unbind(1) if scene.median else [None] * (1 + len(scene.alone))
    rows = zip((features, *alone.unbind(1)), alpha.unbind(1), depth.unbind(1), medians, strict=True)
    return [Rendering(*row) for row in rows]


def warm_up(
    report: Report = SILENT, channels: tuple[int, ...] = (3,), alone_channels: int | None = None
) -> None:
    """Have the kernels for these channel counts ready, compiled or read from disk; says so when compiling.

    alone_channels: of layers rendered alone; None for `rasterize`.
    """
    layered = alone_channels is not None
    with told_to(report.say):
        for count in channels:
            sizes = Sizes(
                16, 16, count, 1 if layered else None, alone_channels or 0, False, SplatSettings(),
                layout.host_lanes(),
            )  # fmt: skip
            own = torch.ones(1, dtype=torch.int32) if layered else None
            mean, camera = torch.tensor([[0.0, 0.0, 2.0]]), torch.eye(4)[None]
            intrinsics = torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]])
            turned, scale = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
            for shape in ((turned, scale, None), (None, None, torch.eye(3)[None] * 0.01)):
                colors = torch.ones(1, count, requires_grad=True)
                arguments = (mean, *shape, torch.ones(1), colors, camera, intrinsics, None)
                with torch.enable_grad():
                    _Rasterize.apply(sizes, own, *arguments)[2].sum().backward()

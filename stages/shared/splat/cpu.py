"""The CPU backend: compiled vector kernels over tiles, float32 pictures, float64 projection.

Forward: project -> sort by depth -> sort into tiles -> blend. Backward: blend again, front to back, into one
slot per (tile, Gaussian) -> sum each Gaussian's slots in order -> backward of the projection. The same bytes
come out whatever the number of threads.
"""

from __future__ import annotations

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
    layers: int | None
    median: bool
    settings: SplatSettings
    lanes: int

    @property
    def specialised(self) -> bool:
        return self.channels in layout.SPECIALISED_CHANNELS

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

    def kernel_sizes(self, layer_ids: np.ndarray | None) -> tuple[Any, ...]:
        """The arguments width ... channels of the blending kernels."""
        lanes = layout.lanes_argument(self.lanes)
        return (
            self.width,
            self.height,
            layer_ids,
            self.layers,
            layout.constants(self.lanes),
            lanes,
            self.argument(self.channels),
        )


@dataclass(frozen=True)
class Gaussians:
    """The inputs as flat float32 arrays; layer_ids int32."""

    means: np.ndarray  # (3N,)
    quats: np.ndarray | None  # (4N,)
    scales: np.ndarray | None  # (3N,)
    covars: np.ndarray | None  # (9N,)
    opacities: np.ndarray  # (N,)
    colors: np.ndarray  # (C N,)
    layer_ids: np.ndarray | None = None  # (N,)

    @property
    def placed(self) -> tuple[Any, ...]:
        """What projection reads."""
        return self.means, self.quats, self.scales, self.covars, self.opacities


@dataclass(frozen=True)
class View:
    """What one camera saw: kept for the backward pass."""

    camera: np.ndarray  # (24,) see kernels/geometry.py
    background: np.ndarray  # (C,)
    records: np.ndarray  # (N * record,)
    counts: np.ndarray  # (N,) tiles per Gaussian
    first_slots: np.ndarray  # (N + 1,)
    starts: np.ndarray  # (tiles + 1,)
    gaussians: np.ndarray  # (E,) tile lists: rows
    slots: np.ndarray  # (E,) and where the gradient of each entry goes, Gaussian by Gaussian
    blocks: np.ndarray  # (E,) blocks of the tile that each entry changed
    layer_ids: np.ndarray | None  # (N,)


def camera_numbers(viewmat: np.ndarray, intrinsics: np.ndarray, sizes: Sizes) -> np.ndarray:
    """One camera as the 24 doubles that the projection reads."""
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * sizes.width / fx, FRUSTUM_MARGIN * 0.5 * sizes.height / fy
    left, right = -cx / fx - margin_x, (sizes.width - cx) / fx + margin_x
    top, bottom = -cy / fy - margin_y, (sizes.height - cy) / fy + margin_y
    options = sizes.settings
    tail = (options.near, options.far, options.eps2d, float(options.antialiased))
    axes = (*viewmat[:3, :3].ravel(), *viewmat[:3, 3])
    return np.array([*axes, fx, fy, cx, cy, left, right, top, bottom, *tail], np.float64)


def _whole_lines(count: int) -> np.ndarray:
    """Uninitialised float32 that begin at a cache line: records and slots are whole lines."""
    room = np.empty(count + 16, np.float32)
    skip = -(room.ctypes.data // 4) % 16
    return room[skip : skip + count]


def arrange(gaussians: Gaussians, camera: np.ndarray, background: np.ndarray, sizes: Sizes) -> View:
    """Project, sort by depth, sort into tiles."""
    n = len(gaussians.opacities)
    records, boxes = _whole_lines(n * sizes.record), np.empty(4 * n, np.uint16)
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
    rows, slots, blocks = (
        np.empty(entries, np.int32),
        np.empty(entries, np.int32),
        np.empty(entries, np.uint32),
    )
    run_together(fill_tiles, order, boxes, first_slots, sizes.columns, tallies, rows, slots)
    return View(
        camera, background, records, counts, first_slots, starts, rows, slots, blocks, gaussians.layer_ids
    )


def blend_view(
    view: View,
    features: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray,
    median: np.ndarray | None,
    sizes: Sizes,
) -> None:
    """Fill the pictures (1 + L, H, W, ...) of one camera."""
    lists = (view.starts, view.gaussians)
    run_together(
        blend, *lists, view.records, sizes.record, view.background, features.reshape(-1),
        alpha.reshape(-1), depth.reshape(-1), view.blocks, *sizes.kernel_sizes(view.layer_ids),
        sizes.argument(2 + sizes.channels),
    )  # fmt: skip
    if median is not None:
        run_together(
            median_depths, *lists, view.blocks, view.records, sizes.record, median.reshape(-1), sizes.width,
            sizes.height, view.layer_ids, sizes.layers, layout.constants(sizes.lanes), sizes.lanes,
        )  # fmt: skip


def view_backward(
    gaussians: Gaussians,
    view: View,
    pictures: list[np.ndarray],
    incoming: list[np.ndarray],
    outgoing: list[np.ndarray | None],
    add: bool,
    sizes: Sizes,
) -> np.ndarray:
    """Write (or add) the gradients of one camera's pictures to `outgoing`; return the camera's own (16,)."""
    lanes, slot = layout.lanes_argument(sizes.lanes), sizes.argument(sizes.slot)
    sums = _whole_lines(len(view.gaussians) * sizes.slot)
    run_together(
        blend_backward, view.starts, view.gaussians, view.slots, view.records, sizes.record, view.background,
        *(x.reshape(-1) for x in pictures), view.blocks, *(x.reshape(-1) for x in incoming), sums,
        *sizes.kernel_sizes(view.layer_ids), slot,
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
    """Pictures (B, 1 + L, H, W, ...) of checked float32 inputs."""

    @staticmethod
    def forward(
        ctx: Any,
        sizes: Sizes,
        layer_ids: Tensor | None,
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
        inputs = (means, quats, scales, covars, opacities, colors, layer_ids)
        gaussians = _gaussians(inputs)
        shape = (len(viewmats), 1 + (sizes.layers or 0), sizes.height, sizes.width)
        features, alpha, depth = torch.empty((*shape, sizes.channels)), torch.empty(shape), torch.empty(shape)
        median = torch.empty(shape if sizes.median else 0)
        behind = torch.zeros(shape[0], sizes.channels) if background is None else background.contiguous()
        views = []
        for i in range(shape[0]):
            camera = camera_numbers(viewmats[i].double().numpy(), Ks[i].double().numpy(), sizes)
            view = arrange(gaussians, camera, behind[i].numpy(), sizes)
            middle = median[i].numpy() if sizes.median else None
            blend_view(view, features[i].numpy(), alpha[i].numpy(), depth[i].numpy(), middle, sizes)
            views.append(view)
        if any(ctx.needs_input_grad):
            ctx.sizes, ctx.views = sizes, views
            ctx.save_for_backward(*inputs, features, alpha, depth)
        ctx.mark_non_differentiable(median)
        return features, alpha, depth, median

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
        *inputs, features, alpha, depth = ctx.saved_tensors
        gaussians = _gaussians(inputs)
        incoming = [x.contiguous() for x in grads[:3]]
        outgoing = [None if x is None else torch.empty(x.shape) for x in inputs[:6]]
        arrays = [None if x is None else x.numpy().reshape(-1) for x in outgoing]
        g_viewmats, g_Ks = torch.zeros(len(views), 4, 4), torch.zeros(len(views), 3, 3)
        for i, view in enumerate(views):
            pictures = [x[i].numpy() for x in (features, alpha, depth)]
            g_pictures = [x[i].numpy() for x in incoming]
            numbers = view_backward(gaussians, view, pictures, g_pictures, arrays, i > 0, sizes)
            g_camera = torch.from_numpy(numbers.clip(-LARGEST, LARGEST)).float()
            g_viewmats[i, :3, :3], g_viewmats[i, :3, 3] = g_camera[:9].reshape(3, 3), g_camera[9:12]
            g_Ks[i, [0, 1, 0, 1], [0, 1, 2, 2]] = g_camera[12:]
        g_background = None
        if ctx.needs_input_grad[10]:
            # numpy's plain sum: one thread, so that its order is fixed.
            g_background = torch.from_numpy(
                np.einsum("bshwc,bshw->bc", incoming[0].numpy(), 1 - alpha.numpy())
            )
        return (None, None, *outgoing, g_viewmats, g_Ks, g_background)


def _gaussians(inputs: Iterable[Tensor | None]) -> Gaussians:
    arrays: list[Any] = [None if x is None else x.detach().contiguous().numpy().reshape(-1) for x in inputs]
    return Gaussians(*arrays)


def render_scene(scene: Scene) -> Rendering:
    """Every camera, composite and layers: fields (1 + L, B, H, W, ...), in the dtype of the means."""
    sizes = Sizes(
        scene.width, scene.height, scene.colors.shape[1], scene.layers or None, scene.median, scene.settings,
        layout.host_lanes(),
    )  # fmt: skip
    inputs = (
        scene.means, scene.quats, scene.scales, scene.covars, scene.opacities, scene.colors, scene.viewmats,
        scene.Ks, scene.background,
    )  # fmt: skip
    singles = [None if x is None else x.float() for x in inputs]
    try:
        pictures = _Rasterize.apply(sizes, scene.layer_ids, *singles)
    except RefusedGaussians:
        check_gaussians(scene)
        raise
    features, alpha, depth, median = (x.to(scene.means.dtype) for x in pictures)
    return Rendering(
        features.transpose(0, 1),
        alpha.transpose(0, 1),
        depth.transpose(0, 1),
        median.transpose(0, 1) if scene.median else None,
    )


def warm_up(report: Report = SILENT, channels: tuple[int, ...] = (3,), layers: bool = False) -> None:
    """Have the kernels for these channel counts ready, compiled or read from disk; says so when compiling."""
    with told_to(report.say):
        for count in channels:
            sizes = Sizes(16, 16, count, 1 if layers else None, False, SplatSettings(), layout.host_lanes())
            ids = torch.zeros(1, dtype=torch.int32) if layers else None
            mean, camera = torch.tensor([[0.0, 0.0, 2.0]]), torch.eye(4)[None]
            intrinsics = torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]])
            turned, scale = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
            for shape in ((turned, scale, None), (None, None, torch.eye(3)[None] * 0.01)):
                colors = torch.ones(1, count, requires_grad=True)
                arguments = (mean, *shape, torch.ones(1), colors, camera, intrinsics, None)
                with torch.enable_grad():
                    _Rasterize.apply(sizes, ids, *arguments)[1].sum().backward()

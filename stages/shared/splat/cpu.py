"""The CPU backend: compiled vector kernels over tiles, float32 pictures, float64 projection.

Forward: project -> sort by depth -> sort into tiles -> blend. Backward: blend again, front to back, into one slot
per (tile, Gaussian) -> sum each Gaussian's slots in order -> backward of the projection. The same bytes come out
whatever the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels import project as projection
from stages.shared.splat.kernels.blend import blend, median_depths
from stages.shared.splat.kernels.blend_backward import blend_backward
from stages.shared.splat.kernels.order import count_tiles, depth_order, fill_tiles, place_tiles
from stages.shared.splat.kernels.threads import run_together
from stages.shared.splat.rendering import Rendering
from stages.shared.splat.scene import Scene
from stages.shared.splat.settings import FRUSTUM_MARGIN, SplatSettings


@dataclass(frozen=True)
class _Sizes:
    """Everything about a call that is not an array."""

    width: int
    height: int
    channels: int
    layers: int | None
    lanes: int
    median: bool
    settings: SplatSettings

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

    @property
    def block_height_shift(self) -> int:
        return (self.lanes // layout.BLOCK_WIDTH).bit_length() - 1

    def kernel_sizes(self) -> tuple[Any, Any, Any]:
        """The arguments ramps, lanes, channels of the blending kernels."""
        return (
            layout.ramps(self.lanes),
            layout.lanes_argument(self.lanes),
            layout.size_argument(self.channels, self.specialised),
        )


@dataclass(frozen=True)
class _Gaussians:
    """The inputs as contiguous float32 arrays."""

    means: np.ndarray
    quats: np.ndarray | None
    scales: np.ndarray | None
    covars: np.ndarray | None
    opacities: np.ndarray
    colors: np.ndarray
    layer_ids: np.ndarray | None

    @property
    def shape(self) -> tuple[Any, ...]:
        return self.means, self.quats, self.scales, self.covars, self.opacities


@dataclass(frozen=True)
class _View:
    """What one camera saw: kept for the backward pass."""

    camera: np.ndarray  # (24,) see kernels/project.py
    background: np.ndarray  # (C,)
    records: np.ndarray  # (N * record,)
    counts: np.ndarray  # (N,) tiles per Gaussian
    first_slots: np.ndarray  # (N + 1,)
    slots: np.ndarray  # (E,) places in the tile lists, Gaussian by Gaussian
    starts: np.ndarray  # (tiles + 1,)
    gaussians: np.ndarray  # (E,)
    blocks: np.ndarray  # (E,)


def _camera(viewmat: np.ndarray, intrinsics: np.ndarray, sizes: _Sizes) -> np.ndarray:
    """One camera as the 24 doubles that the projection reads."""
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * sizes.width / fx, FRUSTUM_MARGIN * 0.5 * sizes.height / fy
    limits = (
        -cx / fx - margin_x,
        (sizes.width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (sizes.height - cy) / fy + margin_y,
    )
    options = sizes.settings
    tail = (options.near, options.far, options.eps2d, float(options.antialiased))
    return np.array([*viewmat[:3, :3].ravel(), *viewmat[:3, 3], fx, fy, cx, cy, *limits, *tail], np.float64)


def _arrange(gaussians: _Gaussians, camera: np.ndarray, background: np.ndarray, sizes: _Sizes) -> _View:
    """Project, sort by depth, sort into tiles."""
    n = len(gaussians.means)
    records = np.empty(n * sizes.record, np.float32)
    boxes = np.empty(4 * n, np.uint16)
    depths, counts = np.empty(n, np.float32), np.empty(n, np.int32)
    run_together(
        projection.project, *gaussians.shape, gaussians.colors, gaussians.layer_ids, camera, float(sizes.width),
        float(sizes.height), records, sizes.record, boxes, depths, counts,
    )  # fmt: skip
    first_slots = np.empty(n + 1, np.int32)
    order = depth_order(depths.view(np.uint32), counts, first_slots)
    entries = int(first_slots[n])
    tallies = np.zeros((max(torch.get_num_threads(), 1), sizes.tiles), np.int32)
    starts = np.empty(sizes.tiles + 1, np.int64)
    run_together(count_tiles, order, boxes, sizes.columns, tallies)
    place_tiles(tallies, starts)
    rows, blocks, slots = (
        np.empty(entries, np.int32),
        np.empty(entries, np.uint32),
        np.empty(entries, np.int32),
    )
    run_together(
        fill_tiles,
        order,
        boxes,
        first_slots,
        sizes.columns,
        sizes.block_height_shift,
        tallies,
        rows,
        blocks,
        slots,
    )
    return _View(camera, background, records, counts, first_slots, slots, starts, rows, blocks)


def _blend(view: _View, features: np.ndarray, alpha: np.ndarray, depth: np.ndarray, sizes: _Sizes) -> None:
    run_together(
        blend, view.starts, view.gaussians, view.blocks, view.records, sizes.record, view.background,
        features.reshape(-1), alpha.reshape(-1), depth.reshape(-1), sizes.width, sizes.height, sizes.layers,
        *sizes.kernel_sizes(),
    )  # fmt: skip


def _median(view: _View, sizes: _Sizes, median: np.ndarray) -> None:
    run_together(
        median_depths, view.starts, view.gaussians, view.blocks, view.records, sizes.record, median.reshape(-1),
        sizes.width, sizes.height, sizes.layers,
    )  # fmt: skip


class _Rasterize(torch.autograd.Function):
    """Pictures (B, 1 + L, H, W, ...) of checked float32 inputs."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        sizes: _Sizes,
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
        gaussians = _Gaussians(
            *(_array(x) for x in (means, quats, scales, covars, opacities, colors, layer_ids))  # type: ignore[arg-type]
        )
        cameras = len(viewmats)
        shape = (cameras, 1 + (sizes.layers or 0), sizes.height, sizes.width)
        features = np.empty((*shape, sizes.channels), np.float32)
        alpha, depth = np.empty(shape, np.float32), np.empty(shape, np.float32)
        median = np.empty(shape if sizes.median else 0, np.float32)
        black = np.zeros((cameras, sizes.channels), np.float32)
        behind = black if background is None else _array(background)
        assert behind is not None
        views = []
        for i in range(cameras):
            camera = _camera(viewmats[i].double().numpy(), Ks[i].double().numpy(), sizes)
            view = _arrange(gaussians, camera, np.ascontiguousarray(behind[i]), sizes)
            _blend(view, features[i], alpha[i], depth[i], sizes)
            if sizes.median:
                _median(view, sizes, median[i])
            views.append(view)
        if any(ctx.needs_input_grad):
            ctx.kept = (sizes, gaussians, views, features, alpha, depth)
        outputs = tuple(torch.from_numpy(x) for x in (features, alpha, depth, median))
        ctx.mark_non_differentiable(outputs[3])
        ctx.set_materialize_grads(True)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        sizes, gaussians, views, features, alpha, depth = ctx.kept
        incoming = [_array(g) for g in grads[:3]]
        means, quats, scales, covars, opacities = gaussians.shape
        outgoing = [None if x is None else np.empty_like(x) for x in (*gaussians.shape, gaussians.colors)]
        turns = -(-len(means) // (layout.GROUP * layout.GROUPS_PER_TURN))
        g_viewmats = np.zeros((len(views), 4, 4), np.float32)
        g_Ks = np.zeros((len(views), 3, 3), np.float32)
        for i, view in enumerate(views):
            sums = np.empty(len(view.gaussians) * sizes.slot, np.float32)
            run_together(
                blend_backward, view.starts, view.gaussians, view.blocks, view.records, sizes.record, view.background,
                *(x[i].reshape(-1) for x in (features, alpha, depth)), *(x[i].reshape(-1) for x in incoming),
                sums, sizes.width, sizes.height, sizes.layers, *sizes.kernel_sizes(),
                layout.size_argument(sizes.slot, sizes.specialised),
            )  # fmt: skip
            shares = np.empty((turns, projection.CAMERA_GRADIENTS), np.float64)
            g_means, g_quats, g_scales, g_covars, g_opacities, g_colors = outgoing
            run_together(
                projection.project_backward, means, quats, scales, covars, opacities, view.camera, view.counts,
                view.first_slots, view.slots, view.blocks, sums, sizes.slot, i > 0, g_means, g_quats, g_scales,
                g_covars, g_opacities, g_colors, shares,
            )  # fmt: skip
            g_camera = shares.sum(0)
            g_viewmats[i, :3, :3], g_viewmats[i, :3, 3] = g_camera[:9].reshape(3, 3), g_camera[9:12]
            g_Ks[i, [0, 1, 0, 1], [0, 1, 2, 2]] = g_camera[12:16]
        g_background = None
        if ctx.needs_input_grad[10]:
            g_background = torch.from_numpy(np.einsum("bshwc,bshw->bc", incoming[0], 1 - alpha))
        gradients = [None if x is None else torch.from_numpy(x) for x in outgoing]
        return (None, None, *gradients, torch.from_numpy(g_viewmats), torch.from_numpy(g_Ks), g_background)


def _array(tensor: Tensor | None) -> np.ndarray | None:
    return None if tensor is None else tensor.detach().contiguous().numpy()


def render_scene(scene: Scene) -> Rendering:
    """Every camera, composite and layers: fields of shape (1 + L, B, H, W, ...), in the dtype of the means."""
    sizes = _Sizes(
        scene.width, scene.height, scene.colors.shape[1], scene.layers or None, layout.host_lanes(), scene.median,
        scene.settings,
    )  # fmt: skip
    inputs = (
        scene.means, scene.quats, scene.scales, scene.covars, scene.opacities, scene.colors, scene.viewmats,
        scene.Ks, scene.background,
    )  # fmt: skip
    singles = [None if x is None else x.float() for x in inputs]
    pictures = _Rasterize.apply(sizes, scene.layer_ids, *singles)
    features, alpha, depth, median = (x.to(scene.means.dtype) for x in pictures)
    return Rendering(
        features.transpose(0, 1), alpha.transpose(0, 1), depth.transpose(0, 1),
        median.transpose(0, 1) if scene.median else None,
    )  # fmt: skip

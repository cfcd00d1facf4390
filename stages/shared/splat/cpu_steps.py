"""The steps of the CPU backend, over flat arrays and one camera at a time; `cpu.py` gives them gradients.

Forward: project -> sort by depth -> sort into tiles -> blend. Backward: blend again, front to back, into one
slot per (tile, Gaussian) -> sum each Gaussian's slots in order -> backward of the projection.
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
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.blend import blend, median_depths
from stages.shared.splat.kernels.blend_backward import blend_backward
from stages.shared.splat.kernels.order import count_tiles, depth_order, fill_tiles, place_tiles
from stages.shared.splat.kernels.project import project
from stages.shared.splat.kernels.project_backward import CAMERA_GRADIENTS, project_backward
from stages.shared.splat.kernels.threads import run_parallel, run_serial
from stages.shared.splat.settings import FRUSTUM_MARGIN, SplatSettings

_MOST_ENTRIES = 1 << 28


class RefusedGaussians(Exception):
    """Projection met numbers that cannot be rendered."""


@dataclass(frozen=True)
class Sizes:
    """Everything about a call that is not an array."""

    width: int
    height: int
    channels: int
    alone: int | None  # number of layers rendered alone; None without layers
    alone_channels: int
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
        """A size that kernels are specialised for, or one that they read at run time."""
        return layout.size_argument(size, self.specialised)

    def kernel_sizes(self, layer_slots: np.ndarray | None) -> tuple[Any, ...]:
        """The arguments width ... lanes of the blending kernels."""
        lanes, constants = layout.lanes_argument(self.lanes), layout.constants(self.lanes, self.settings)
        return self.width, self.height, layer_slots, self.alone, constants, lanes


@dataclass(frozen=True)
class FlatGaussians:
    """The inputs as flat arrays; layer_slots int32: from 1 on, 0 for the composite only."""

    means: np.ndarray  # (3N,)
    quats: np.ndarray | None  # (4N,)
    scales: np.ndarray | None  # (3N,)
    covars: np.ndarray | None  # (9N,)
    opacities: np.ndarray  # (N,)
    colors: np.ndarray  # (C N,)
    layer_slots: np.ndarray | None = None  # (N,)

    @property
    def placed(self) -> tuple[Any, ...]:
        """What projection reads."""
        return self.means, self.quats, self.scales, self.covars, self.opacities


@dataclass(frozen=True)
class ProjectedView:
    """The projection for one camera, kept for the backward pass."""

    camera: np.ndarray  # (25,) see kernels/geometry.py
    background: np.ndarray  # (C,)
    records: np.ndarray  # (N * record,)
    counts: np.ndarray  # (N,) tiles per Gaussian
    first_slots: np.ndarray  # (N + 1,)
    starts: np.ndarray  # (tiles + 1,)
    gaussians: np.ndarray  # (E,) tile lists: rows
    slots: np.ndarray  # (E,) and where the gradient of each entry goes, Gaussian by Gaussian
    blocks: np.ndarray  # (E,) blocks of the tile in which each entry changed the composite
    layer_blocks: np.ndarray  # (E,) the same for its layer's picture; empty without layers
    layer_slots: np.ndarray | None  # (N,)


@dataclass(frozen=True)
class PixelBuffers:
    """Of one camera, or their gradients: the composite's features, those of the layers alone, and of all."""

    features: np.ndarray  # (H, W, C)
    alone_features: np.ndarray  # (A, H, W, C')
    alpha: np.ndarray  # (1 + A, H, W)
    depth: np.ndarray  # (1 + A, H, W)

    @classmethod
    def of(cls, tensors: Iterable[Tensor], camera: int) -> PixelBuffers:
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


def arrange(
    gaussians: FlatGaussians, camera: np.ndarray, background: np.ndarray, sizes: Sizes
) -> ProjectedView:
    """Project, sort by depth, sort into tiles."""
    n = len(gaussians.opacities)
    records, boxes = _whole_lines(n * sizes.record, sizes), np.empty(4 * n, np.uint16)
    depths, counts = np.empty(n, np.float32), np.empty(n, np.int32)
    run_parallel(
        project, *gaussians.placed, gaussians.colors, sizes.channels, camera,
        float(sizes.width), float(sizes.height), records, sizes.record, boxes, depths, counts,
    )  # fmt: skip
    first_slots = np.empty(n + 1, np.int32)
    order, entries = run_serial(depth_order, depths.view(np.uint32), counts, first_slots)
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
    run_parallel(count_tiles, order, boxes, sizes.columns, tallies)
    run_serial(place_tiles, tallies, starts)
    rows, slots = (np.empty(entries, np.int32) for _ in range(2))
    blocks, layer_blocks = (np.empty(size, np.uint32) for size in (entries, entries if sizes.alone else 0))
    run_parallel(fill_tiles, order, boxes, first_slots, sizes.columns, tallies, rows, slots)
    return ProjectedView(
        camera, background, records, counts, first_slots, starts, rows, slots, blocks, layer_blocks,
        gaussians.layer_slots,
    )  # fmt: skip


def blend_view(view: ProjectedView, pictures: PixelBuffers, median: np.ndarray | None, sizes: Sizes) -> None:
    """Fill the pictures of one camera; `median` is (1 + A, H, W)."""
    lists, blocks = (view.starts, view.gaussians), (view.blocks, view.layer_blocks)
    run_parallel(
        blend, *lists, view.records, sizes.record, view.background, *pictures.flat, *blocks,
        *sizes.kernel_sizes(view.layer_slots), sizes.argument(2 + sizes.channels),
        sizes.argument(2 + sizes.alone_channels),
    )  # fmt: skip
    if median is not None:
        run_parallel(
            median_depths, *lists, *blocks, view.records, sizes.record, median.reshape(-1),
            *sizes.kernel_sizes(view.layer_slots),
        )  # fmt: skip


def view_backward(
    gaussians: FlatGaussians,
    view: ProjectedView,
    pictures: PixelBuffers,
    incoming: PixelBuffers,
    outgoing: list[np.ndarray | None],
    add: bool,
    sizes: Sizes,
) -> np.ndarray:
    """Write (or add) the gradients of one camera's pictures to `outgoing`; return the camera's own (16,)."""
    lanes, slot = layout.lanes_argument(sizes.lanes), sizes.argument(sizes.slot)
    sums = _whole_lines(len(view.gaussians) * sizes.slot, sizes)
    run_parallel(
        blend_backward, view.starts, view.gaussians, view.slots, view.records, sizes.record, view.background,
        *pictures.flat, view.blocks, view.layer_blocks, *incoming.flat, sums,
        *sizes.kernel_sizes(view.layer_slots), sizes.argument(sizes.channels), slot,
        sizes.argument(sizes.alone_channels),
    )  # fmt: skip
    turns = -(-len(gaussians.opacities) // (layout.GROUP * layout.GROUPS_PER_TURN))
    shares = np.empty(turns * CAMERA_GRADIENTS, np.float64)
    seen = (view.camera, view.counts, view.first_slots)
    run_parallel(
        project_backward, *gaussians.placed, *seen, sums, lanes, slot, sizes.channels, add,
        *outgoing, shares,
    )  # fmt: skip
    return shares.reshape(turns, CAMERA_GRADIENTS).sum(0)

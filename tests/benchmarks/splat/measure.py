"""One case of the benchmark: times, phases, work done, memory, and the distance to the machine's limit."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.splat import cpu_steps
from stages.shared.splat.api import rasterize
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.threads import run_parallel, time_kernels
from stages.shared.splat.settings import SplatSettings
from tests.benchmarks.splat.figure import Figure, make_camera, make_figure
from tests.benchmarks.splat.limit import Limit, flops_per_pair
from tests.benchmarks.splat.memory import peak_bytes
from tests.benchmarks.splat.peers import gsplat_torch
from tests.benchmarks.splat.tally import tally

# Kernels that do not blend, for the share of everything else.
_FORWARD_PHASES = ("project", "depth_order", "count_tiles", "place_tiles", "fill_tiles", "blend")
_BACKWARD_PHASES = ("blend_backward", "project_backward")


@dataclass(frozen=True)
class Case:
    """`gaussians` of them in a picture of size x size px with `channels` features."""

    gaussians: int
    size: int
    channels: int

    @property
    def name(self) -> str:
        return f"{self.gaussians}@{self.size}x{self.channels}"


def measure(case: Case, rounds: int, limit: Limit, backend: str = "cpu") -> dict[str, Any]:
    """Time forward and forward + backward (loss on all outputs), median and least of `rounds`.

    backend: one of `rasterize`, or "gsplat-torch" (see `peers`).
    """
    figure = make_figure(case.gaussians, case.channels)
    view, intrinsics = make_camera(case.size)
    background = torch.ones(case.channels)
    generator = torch.Generator().manual_seed(1)
    shape = (case.size, case.size)
    weights = [torch.randn(*shape, *c, generator=generator) for c in ((case.channels,), (), ())]

    def render(figure: Figure) -> Any:
        if backend == "gsplat-torch":
            return gsplat_torch(figure, view, intrinsics, case.size, case.size, background)
        return rasterize(
            figure.means, figure.quats, figure.scales, figure.opacities, figure.colors, view, intrinsics,
            case.size, case.size, background=background, backend=backend,
        )  # fmt: skip

    def forward() -> None:
        with torch.no_grad():
            render(figure)

    def both() -> None:
        leaves = Figure(*(x.clone().requires_grad_() for x in vars(figure).values()))
        picture = render(leaves)
        fields = (picture.features, picture.alpha, picture.depth)
        sum(((a * b).sum() for a, b in zip(fields, weights, strict=True)), torch.zeros(())).backward()

    found: dict[str, Any] = {"backend": backend, "gaussians": case.gaussians, "size": case.size}
    found |= {"channels": case.channels, "threads": torch.get_num_threads(), "rounds": rounds}
    found |= peak_bytes(both)  # first: later calls find memory that this one has left
    seconds, _ = _repeat(forward, rounds)
    both_seconds, phases = _repeat(both, rounds)
    found |= _milliseconds("forward", seconds) | _milliseconds("forward_backward", both_seconds)
    found["frames_per_second"] = 1 / statistics.median(seconds)
    found["steps_per_second"] = 1 / statistics.median(both_seconds)
    if backend == "cpu":
        names = [name for name in (*_FORWARD_PHASES, *_BACKWARD_PHASES) if name in phases[0]]
        medians = {name: 1e3 * statistics.median(row[name] for row in phases) for name in names}
        least = {name: 1e3 * min(row[name] for row in phases) for name in names}
        found["phase_milliseconds"], found["phase_least_milliseconds"] = medians, least
        found |= _work(case, figure, view, intrinsics, least, limit)
    return found


def _repeat(call: Callable[[], None], rounds: int) -> tuple[list[float], list[dict[str, float]]]:
    """Wall seconds of `rounds` calls after one that warms up, and seconds by kernel of each."""
    call()
    seconds, phases = [], []
    for _ in range(rounds):
        with time_kernels() as kernels:
            started = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - started)
        phases.append(dict(kernels))
    return seconds, phases


def _milliseconds(name: str, seconds: list[float]) -> dict[str, float]:
    return {
        f"{name}_milliseconds": 1e3 * statistics.median(seconds),
        f"{name}_least_milliseconds": 1e3 * min(seconds),
    }


def _work(
    case: Case, figure: Figure, view: Tensor, intrinsics: Tensor, least: dict[str, float], limit: Limit
) -> dict[str, Any]:
    """Pairs blended, lanes used, memory of the call's buffers, and how near the limit it came.

    Two limits, for as many cores as threads: `peak`, the multiply-add peak if nothing but the arithmetic of
    pairs cost time; `hot`, the blending steps at their cost in the first-level cache with no lane idle.
    """
    lanes = limit.lanes
    sizes = cpu_steps.Sizes(case.size, case.size, case.channels, None, 0, SplatSettings(), lanes)
    arrays = (figure.means, figure.quats, figure.scales, None, figure.opacities, figure.colors)
    gaussians = cpu_steps.FlatGaussians(*(None if x is None else x.reshape(-1).numpy() for x in arrays))  # type: ignore[arg-type]
    camera = cpu_steps.camera_numbers(view.double().numpy(), intrinsics.double().numpy(), sizes)
    placed = cpu_steps.arrange(gaussians, camera, np.ones(case.channels, np.float32), sizes)
    counts = np.zeros((sizes.tiles, 2), np.int64)
    run_parallel(
        tally, placed.starts, placed.gaussians, placed.records, sizes.record, sizes.width, sizes.height,
        layout.constants(lanes), layout.lanes_argument(lanes), counts,
    )  # fmt: skip
    pairs, steps = (int(x) for x in counts.sum(0))
    shape = (1, case.size, case.size)
    features, alpha, depth = (np.empty((*shape, *c), np.float32) for c in ((case.channels,), (), ()))
    nothing = np.empty((0, *shape[1:], 0), np.float32)
    cpu_steps.blend_view(placed, cpu_steps.PixelBuffers(features, nothing, alpha, depth), None, sizes)
    backward_steps = int(np.bitwise_count(placed.blocks).sum())
    entries = len(placed.gaussians)
    covered = int((alpha > 0).sum())
    kept = sum(x.nbytes for x in vars(placed).values() if isinstance(x, np.ndarray))
    threads = torch.get_num_threads()
    forward_flops, backward_flops = flops_per_pair(case.channels)
    forward_ms, backward_ms = least["blend"], least["blend_backward"]
    hot = {
        "forward": 1e-6 * pairs / lanes * limit.forward_nanoseconds / threads,
        "backward": 1e-6 * pairs / lanes * limit.backward_nanoseconds / threads,
    }
    peak = {
        "forward": 1e3 * pairs * forward_flops / limit.flops_per_second / threads,
        "backward": 1e3 * pairs * backward_flops / limit.flops_per_second / threads,
    }
    everything = sum(least.values())
    return {
        "tile_entries": entries,
        "pairs": pairs,
        "pairs_per_covered_pixel": pairs / max(covered, 1),
        "forward_pairs_per_second": 1e3 * pairs / forward_ms,
        "backward_pairs_per_second": 1e3 * pairs / backward_ms,
        "forward_lane_use": pairs / max(steps * lanes, 1),
        "backward_lane_use": pairs / max(backward_steps * lanes, 1),
        "hot_bound_milliseconds": hot,
        "peak_bound_milliseconds": peak,
        "fraction_of_hot_bound": {
            "forward": hot["forward"] / forward_ms,
            "backward": hot["backward"] / backward_ms,
        },
        "fraction_of_peak": {
            "forward": peak["forward"] / forward_ms,
            "backward": peak["backward"] / backward_ms,
        },
        "share_outside_blending": 1 - (forward_ms + backward_ms) / everything,
        "buffer_bytes": kept + 4 * entries * sizes.slot,
    }

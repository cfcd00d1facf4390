"""What this machine can do at best: the peak of its vector units, the cost of the blending steps in cache."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stages.shared.splat import cpu_steps
from stages.shared.splat.kernels import layout
from stages.shared.splat.kernels.threads import time_kernels
from stages.shared.splat.settings import SplatSettings
from tests.benchmarks.splat.peak import CHAINS, multiply_add_peak

_ROUNDS = 20_000


@dataclass(frozen=True)
class Limit:
    """Of one core. flops_per_second: float32 multiply-adds, counted as two. *_nanoseconds: one register full
    of pixels (`lanes`) blended with a Gaussian, everything in the first-level cache and no lane idle."""

    lanes: int
    flops_per_second: float
    forward_nanoseconds: float
    backward_nanoseconds: float


def flops_per_pair(channels: int) -> tuple[int, int]:
    """Floating-point operations of one (Gaussian, pixel) pair, forward and backward, counted by hand.

    Forward: distances 2, u and v 6, exponent 4, cut 1, power 13, clamp 1, transmittance 5, and 2 for each
    channel and the depth. Backward: the same without the channels, then 4 for each channel and the depth
    (value and gradient), rest 2, 1 / (1 - alpha) 2, gradient of alpha 3, and 13 for the six geometric sums.
    """
    sums = 2 * (channels + 1)
    return 32 + sums, 32 + 2 * sums + 20


def measure_limit(channels: int, lanes: int) -> Limit:
    """Measure on this thread; about a second."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        forward, backward = _hot_steps(channels, lanes)
        return Limit(lanes, _peak(lanes), forward, backward)
    finally:
        torch.set_num_threads(before)


def _peak(lanes: int) -> float:
    data = np.full(5 * lanes, 0.5, np.float32)
    argument = layout.lanes_argument(lanes)
    seconds = _best(lambda: multiply_add_peak(np.zeros(8, np.int64), data, _ROUNDS, argument))
    return 2.0 * CHAINS * lanes * _ROUNDS / seconds


def _hot_steps(channels: int, lanes: int) -> tuple[float, float]:
    """Nanoseconds per step of both directions: faint Gaussians that fill a tile, so that no lane ever rests.

    The difference between a long list and a short one leaves out what a tile costs whatever its list.
    """
    short, long = 40, 200
    costs = {count: _list_costs(count, channels, lanes) for count in (short, long)}
    steps = (long - short) * layout.TILE_PIXELS // lanes
    forward, backward = (1e9 * (b - a) / steps for a, b in zip(costs[short], costs[long], strict=True))
    return forward, backward


def _list_costs(count: int, channels: int, lanes: int) -> tuple[float, float]:
    """Least seconds to blend one tile with a list of `count` Gaussians, forward and backward."""
    sizes = cpu_steps.Sizes(layout.TILE, layout.TILE, channels, None, 0, SplatSettings(), lanes)
    ones = np.ones(count, np.float32)
    centers, unturned = np.array([0, 0, 2], np.float32), np.array([1, 0, 0, 0], np.float32)
    gaussians = cpu_steps.FlatGaussians(
        np.tile(centers, count), np.tile(unturned, count), np.tile(ones, 3), None, 0.008 * ones,
        np.tile(ones, channels),
    )  # fmt: skip
    intrinsics = np.array([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]])
    black = np.zeros(channels, np.float32)
    view = cpu_steps.arrange(gaussians, cpu_steps.camera_numbers(np.eye(4), intrinsics, sizes), black, sizes)
    shape = (1, layout.TILE, layout.TILE)
    pictures = cpu_steps.PixelBuffers(
        np.ones((*shape, channels), np.float32), np.empty((0, *shape[1:], 0), np.float32),
        np.ones(shape, np.float32), np.ones(shape, np.float32),
    )  # fmt: skip
    grads: list[Any] = [
        None if x is None else np.empty_like(x) for x in (*gaussians.placed, gaussians.colors)
    ]
    seconds = []
    for _ in range(200):
        with time_kernels() as phases:
            cpu_steps.blend_view(view, pictures, None, sizes)
            cpu_steps.view_backward(gaussians, view, pictures, pictures, grads, False, sizes)
        seconds.append((phases["blend"], phases["blend_backward"]))
    forward, backward = (min(column) for column in zip(*seconds, strict=True))
    return forward, backward


def _best(call: Any, repeats: int = 200) -> float:
    """Least seconds of many calls: what the machine can do when nobody disturbs."""
    call()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return min(seconds)

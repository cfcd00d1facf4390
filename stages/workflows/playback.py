"""Measure how fast an outfit plays: from a row of the pose file to a finished picture in memory.

Reads:
    bundles `.gwg`, a pose file. Writes nothing; times are medians over frames, in milliseconds.

Three paths are timed: the plain one (`Outfit.composite`, one frame after the other), the cached one
(`CachedPoser`), and frames in parallel (`parallel_frames`), whose rate is frames over wall time. The
penetration pass is on. Each frame is also rendered without it, and the difference is its cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body import Poses
from stages.shared.capture import Camera
from stages.shared.errors import UsageProblem
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.parallel_frames import parallel_frames
from stages.shared.outfit.penetration import TRYON_MARGINS
from stages.shared.outfit.render_image import RenderedImage, render_image
from stages.shared.outfit.sources import read_bundles
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.outfit.visibility_culling import find_hidden_texels
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from stages.shared.splat.gaussians import Gaussians
from stages.workflows.config import PlaybackConfig

Mask = NDArray[np.bool_] | None
_WARM_FRAMES = 3  # compilation, first touch of memory


@dataclass(frozen=True)
class PlaybackResult:
    """Measured times and the outfit."""

    summary: dict[str, Any]


def run(
    bundles: Sequence[Path],
    poses_path: Path,
    config: PlaybackConfig = PlaybackConfig(),
    report: Report = SILENT,
) -> PlaybackResult:
    """Play an outfit and measure the time.

    Raises:
        UsageProblem: no frames, or garments that cannot be worn together. MissingInput, BadData: files.
    """
    if config.frames < 1 or config.size < 16:
        raise UsageProblem("There is nothing to play.", "options --frames and --size", "Ask for more.")
    outfit = outfit_of_bundles(read_bundles(bundles))
    poses = load_poses(poses_path, outfit.body_model)
    rows = [int(row) for row in np.linspace(0, len(poses) - 1, config.frames)]
    cameras = viewpoint_cameras(
        config.camera, outfit.body_model, poses[rows], outfit.betas, (config.size, config.size)
    )
    frames = list(zip(rows, cameras, strict=True))
    report.step(f"playing {' < '.join(outfit.names)}, {outfit.gaussians} Gaussians")
    hidden = find_hidden_texels(outfit, poses, rows) if config.cull else None
    split = _split(outfit, poses, frames, hidden)
    plain = _plain(outfit, poses, frames[: config.plain_frames])
    rate, threads = _rate(outfit, poses, frames, config.threads or torch.get_num_threads(), hidden)
    one = split["pose"] + split["picture"]
    summary = {
        "layers": list(outfit.names),
        "decoders": {layer.name: layer.model.model_config.decoder for layer in outfit.layers},
        "gaussians": outfit.gaussians,
        "hidden_gaussians": 0 if hidden is None else int(hidden.sum()),
        "size": config.size,
        "frames": len(frames),
        "threads": threads,
        "frames_per_second": round(rate, 2),
        "one_after_the_other_frames_per_second": round(1000 / one, 2),
        "plain_frames_per_second": round(1000 / plain, 2) if plain else None,
        "milliseconds": {name: round(value, 2) for name, value in split.items()},
        "penetration_share": round(max(0.0, split["picture"] - split["picture_without_pass"]) / one, 3),
    }
    return PlaybackResult(summary)


def _split(outfit: Outfit, poses: Poses, frames: list[tuple[int, Camera]], hidden: Mask) -> dict[str, float]:
    """Median milliseconds of posing and of the picture, with and without the penetration pass."""
    player = CachedPoser(outfit, hidden=hidden)
    times: dict[str, list[float]] = {"pose": [], "picture": [], "picture_without_pass": []}
    for index, (row, camera) in enumerate([*frames[:1] * _WARM_FRAMES, *frames]):
        composite, posing = _timed(player.composite, poses, row)
        _, repaired = _timed(render_image, composite, camera, TRYON_MARGINS)
        _, without = _timed(render_image, composite, camera)
        if index >= _WARM_FRAMES:
            for name, value in zip(times, (posing, repaired, without), strict=True):
                times[name].append(value)
    return {name: median(values) for name, values in times.items()}


def _plain(outfit: Outfit, poses: Poses, frames: list[tuple[int, Camera]]) -> float | None:
    """Median milliseconds of a frame on the plain path, or None without frames."""

    def frame(row: int, camera: Camera) -> RenderedImage:
        return render_image(outfit.composite(poses, row), camera, TRYON_MARGINS)

    times = [_timed(frame, row, camera)[1] for row, camera in frames]
    return median(times) if times else None


def _rate(
    outfit: Outfit, poses: Poses, frames: list[tuple[int, Camera]], threads: int, hidden: Mask
) -> tuple[float, int]:
    """Frames per second of parallel frames: frames over wall time, without the first ones."""

    def work(player: CachedPoser, frame: tuple[int, Camera]) -> Gaussians | RenderedImage:
        return render_image(player.composite(poses, frame[0]), frame[1], TRYON_MARGINS)

    started, ahead = 0.0, 2 * threads  # frames in flight when the clock starts
    for index, _ in enumerate(parallel_frames(outfit, frames[:1] * ahead + frames, work, threads, hidden)):
        if index == ahead - 1:
            started = time.perf_counter()
    return len(frames) / (time.perf_counter() - started), threads


def _timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    started = time.perf_counter()
    result = call(*arguments)
    return result, 1000 * (time.perf_counter() - started)

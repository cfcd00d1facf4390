"""What each economy saves: a training step and a played frame, with all economies and with one left out.

Reads what `gw train` reads, and for the frames its result. Writes, into the output folder:
    economy.json: {"summary": [{"part", "on", "off", "times_faster", …}], "left_out": [row …],
        "rows": [{"row", "without", "seconds", "peak_bytes", "slower", "psnr", …}]};
    economy.md: the same as tables.

Every row is measured by a process of its own (option --row), so that its peak memory is its own. The first
row of each part has all economies; the others are compared with it. The rows with all and with none take
turns, as many times as there are rounds, before the others.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from stages.shared.artifacts import write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.avatar.compose import compose
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import UsageProblem
from stages.shared.outfit import render_image as image_module
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.parallel_frames import parallel_frames
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.render_image import RenderedImage, render_image
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.outfit.visibility_culling import find_hidden_texels
from stages.shared.report import SILENT, Report
from stages.train.config import TrainConfig
from stages.train.objective import render
from stages.train.stage import prepare
from stages.train.trainer import Trainer
from stages.train.views import View
from tests.benchmarks.economy.table import compared, markdown, summed_up
from tests.benchmarks.process import run_module
from tests.benchmarks.step import TimingConfig, measure
from tests.every_joint import every_joint

STEP_ROWS: dict[str, str] = {
    "step": "all economies",
    "step-whole-grid": "networks and anchors see the whole grid, not the layer's window",
    "step-all-networks": "networks in every layer, also where the preset leaves them out",
    "step-pass-per-camera": "the networks run once for every camera",
    "step-separate-pictures": "colours, labels and the body alone are drawn by a call each",
    "step-every-joint": "all 55 joints take part in skinning, also those at rest or without weight",
    "step-whole-images": "pictures are not cropped to the subject",
    "step-same-networks": "none of these, but networks where the preset has them",
    "step-nothing-saved": "none of these",
}
FRAME_ROWS: dict[str, str] = {
    "frame": "all economies",
    "frame-no-cull": "body Gaussians that nobody can see are drawn",
    "frame-every-joint": "all 55 joints take part in what anchors and networks see",
    "frame-plain": "posed layer by layer in torch, not by the fused kernel",
    "frame-whole-layers": "the penetration pass draws every layer alone over the whole picture",
    "frame-one-at-a-time": "one frame after the other, all cores at each",
    "frame-nothing-saved": "none of these",
}
STILL_ROWS: dict[str, str] = {
    "still": "all economies, one pose from many sides",
    "still-anew": "layers that stand still are posed again for every picture",
}
ROWS = {**STEP_ROWS, **FRAME_ROWS, **STILL_ROWS}
ENDS = ("step", "step-nothing-saved", "frame", "frame-nothing-saved")
"""What the summary compares; measured first, in turns."""
RESULT_NAME, TABLE_NAME = "economy.json", "economy.md"
_PASSES = 3  # over the frames, each timed


@dataclass(frozen=True)
class EconomyConfig:
    """What is measured.

    Attributes:
        steps: of training that are timed. frames: that are played and compared with the truth.
        rounds: how often the rows with all economies and with none are measured, in turns; the other rows
            are measured once.
        minutes: leave out rows that would take longer than this in all; 0 for no limit.
    """

    steps: int = 5
    frames: int = 12
    rounds: int = 1
    minutes: float = 0.0


def run(
    subject: Path, output: Path, preset: str, config: EconomyConfig = EconomyConfig(), report: Report = SILENT
) -> dict[str, Any]:
    """Every row in a process of its own; the result so far is written after each.

    Raises:
        UsageProblem: nothing to measure. CommandFailed: a row failed, as the frames of an untrained subject.
    """
    if min(config.steps, config.frames, config.rounds) < 1:
        raise UsageProblem(
            "There is nothing to measure.", "options --steps, --frames and --rounds", "Give more."
        )
    started, longest = time.monotonic(), {"step": 0.0, "frame": 0.0, "still": 0.0}
    found: dict[str, list[dict[str, Any]]] = {}
    left_out: list[str] = []
    order = [*ENDS * config.rounds, *(name for name in ROWS if name not in ENDS)]
    for index, name in enumerate(order):
        part = name.split("-")[0]
        passed = time.monotonic() - started
        expected = longest[part] or max(longest.values())
        if config.minutes and set(ENDS) <= set(found) and passed + expected > 60 * config.minutes:
            left_out += [name] if name not in found else []
            continue
        report.step(ROWS[name])
        done = run_module(
            "tests.benchmarks.economy", subject, "--row", name, "--preset", preset,
            "--steps", str(config.steps), "--frames", str(config.frames),
        )  # fmt: skip
        found.setdefault(name, []).append({**done.result, "peak_bytes": done.peak_bytes})
        longest[part] = max(longest[part], done.seconds)
        rows = [_median(found[name]) for name in ROWS if name in found]
        told = write_results(output, rows, left_out, preset, config)
        report.progress(index + 1, len(order))
    told = write_results(output, rows, left_out, preset, config)
    return {"path": output, **told}


def _median(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of all its rounds."""
    seconds = [row["seconds"] for row in rounds]
    return {
        **rounds[0],
        "seconds": statistics.median(seconds),
        "seconds_of_rounds": seconds,
        "peak_bytes": max(row["peak_bytes"] for row in rounds),
    }


def measure_row(subject: Path, name: str, train: TrainConfig, config: EconomyConfig) -> dict[str, Any]:
    """One row in this process: its name, what is left out, seconds (medians), and of frames the PSNR (dB).

    Raises:
        UsageProblem: no such row. MissingInput: the subject is not trained, for frames.
    """
    if name not in ROWS:
        raise UsageProblem(
            f"There is no row {name!r}.", "option --row", "Choose of: " + ", ".join(ROWS) + "."
        )
    found = _step(subject, name, train, config) if name in STEP_ROWS else _frame(subject, name, train, config)
    return {"row": name, "without": ROWS[name], **found}


def whole_grid(maps: LayerMaps) -> LayerMaps:
    """The same texels on a window as large as the grid."""
    return replace(maps, window=(0, 0, maps.grid_size, maps.grid_size))


def write_results(
    output: Path, rows: list[dict[str, Any]], left_out: list[str], preset: str, config: EconomyConfig
) -> dict[str, Any]:
    """Result and table of the rows so far; returns summary, rows and what was left out."""
    told = compared(rows)
    result = {"summary": summed_up(told), "left_out": left_out, "rows": told}
    content = {"format": "gw-economy", "version": 2, "preset": preset, "config": asdict(config), **result}
    write_whole(output / RESULT_NAME, readable_json(content))
    write_whole(output / TABLE_NAME, markdown(result, ROWS).encode())
    return result


def _step(subject: Path, name: str, train: TrainConfig, config: EconomyConfig) -> dict[str, Any]:
    """Seconds of a late training step, and PSNR (dB) of the pictures that training begins with."""
    nothing = name in ("step-nothing-saved", "step-same-networks")
    with every_joint() if nothing or name == "step-every-joint" else nullcontext():
        return _timed_step(subject, name, nothing, train, config)


def _timed_step(
    subject: Path, name: str, nothing: bool, train: TrainConfig, config: EconomyConfig
) -> dict[str, Any]:
    if name in ("step-nothing-saved", "step-all-networks"):
        train = replace(train, model=replace(train.model, networks="all"))
    trainer = prepare(subject, train, whole_grid if nothing or name == "step-whole-grid" else None)
    if nothing or name == "step-whole-images":
        trainer.views.margin = 1 << 16  # px: all of every picture
    trainer.one_pass = trainer.one_pass and not (nothing or name == "step-pass-per-camera")
    psnr = _first_pictures(trainer, config.frames)
    found = measure(trainer, TimingConfig(steps=config.steps).steps, SILENT)
    separate = nothing or name == "step-separate-pictures"
    return {
        "seconds": found["step_seconds_separate" if separate else "step_seconds"],
        "psnr": psnr,
        "gaussians": found["gaussians"],
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "pixels": found["pixels"],
    }


@torch.no_grad()
def _first_pictures(trainer: Trainer, count: int) -> float:
    """Mean PSNR (dB) of a trainer's pictures inside the masks, before it has learned anything."""
    found = []
    for view in _views(trainer, count):
        picture = render(compose(trainer.posed(view.frame)), view.camera)
        found.append(_psnr(picture.color.numpy(), view))
    return float(np.mean(found))


def _frame(subject: Path, name: str, train: TrainConfig, config: EconomyConfig) -> dict[str, Any]:
    """Seconds of a frame from pose to pixels, and PSNR (dB) inside the masks of training pictures."""
    outfit = TrainedSubject.open(subject).outfit()
    trainer = prepare(subject, train)

    def without(row: str) -> bool:
        return name in (row, "frame-nothing-saved")

    with every_joint() if without("frame-every-joint") else nullcontext():
        return _timed_frames(outfit, trainer, without, config, name)


def _timed_frames(
    outfit: Outfit, trainer: Trainer, without: Callable[[str], bool], config: EconomyConfig, name: str
) -> dict[str, Any]:
    poses, shown = trainer.views.poses, _views(trainer, config.frames)

    hidden = None if without("frame-no-cull") else find_hidden_texels(outfit, poses, trainer.frames)
    plain, whole_layers = without("frame-plain"), without("frame-whole-layers")
    threads = 1 if without("frame-one-at-a-time") else torch.get_num_threads()

    still = name in STILL_ROWS  # the pose of the first frame, before the cameras of all

    def work(player: CachedPoser, view: View) -> RenderedImage:
        row = shown[0].frame if still else view.frame
        composite = (outfit if plain else player).composite(poses, row)
        return render_image(composite, view.camera, PenetrationConfig())

    ahead = 2 * threads  # frames in flight when the clock starts
    items = shown[:1] * ahead + shown * _PASSES
    times, errors = [], []
    every_layer = patch.object(image_module, "_on_cpu", return_value=False) if whole_layers else nullcontext()
    with every_layer:  # without tile lists, the penetration pass draws every layer over the whole picture
        for index, shot in enumerate(
            parallel_frames(outfit, items, work, threads, hidden, name != "still-anew")
        ):
            times.append(time.perf_counter())
            if ahead <= index < ahead + len(shown):
                errors.append(_psnr(shot.color, shown[index - ahead]))
    ends = [times[ahead - 1 + turn * len(shown)] for turn in range(_PASSES + 1)]
    return {
        "seconds": statistics.median(np.diff(ends)) / len(shown),
        **({} if still else {"psnr": float(np.mean(errors))}),
        "gaussians": outfit.gaussians - (0 if hidden is None else int(hidden.sum())),
        "threads": torch.get_num_threads(),
    }


def _psnr(color: Any, view: View) -> float:
    """dB inside the mask of a view; color (H, W, 3) on black."""
    inside = view.inside.numpy() > 0
    error = float(np.square(color - view.image.numpy())[inside].mean())
    return -10 * float(np.log10(max(error, 1e-12)))


def _views(trainer: Trainer, count: int) -> list[View]:
    """Training pictures, spread over frames and cameras."""
    frames, cameras = trainer.frames, trainer.cameras
    rows = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [trainer.views.view(frames[row], cameras[place % len(cameras)]) for place, row in enumerate(rows)]

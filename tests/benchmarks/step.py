"""Where the seconds of a training step go, and what sharing one traversal saves.

Reads what `gw train` reads; writes nothing.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import torch
import typer
from torch import Tensor

from gw_cli.console import Console
from gw_cli.options import Json, Preset, Recompute, Subject, preset_config
from stages.shared.avatar.compose import compose
from stages.shared.capture import Camera
from stages.shared.errors import UsageProblem
from stages.shared.layers import BODY
from stages.shared.report import SILENT, Report
from stages.shared.splat.api import rasterize
from stages.shared.splat.gaussians import Gaussians
from stages.shared.splat.kernels.threads import time_kernels
from stages.train.config import TrainConfig
from stages.train.objective import render
from stages.train.stage import prepare
from stages.train.trainer import Trainer
from stages.train.views import choose
from tests.benchmarks.command import application

_SHARE_OF_RUN = 0.9
"""The steps measured are late ones: full-size pictures, all terms in force."""
_BACKWARD_KERNELS = ("blend_backward", "project_backward")

Draw = Callable[[Gaussians, Camera], list[Tensor]]


@dataclass(frozen=True)
class TimingConfig:
    """steps: measured after one that warms up. threads: 0 is torch's number. update: with Adam's part."""

    steps: int = 5
    threads: int = 0
    update: bool = True


def run(
    subject: Path, train: TrainConfig, config: TimingConfig = TimingConfig(), report: Report = SILENT
) -> dict[str, Any]:
    """Medians over a few steps of a new run, by phase; the splatting of a step by itself, both ways.

    Keys: `step_seconds` and `phase_seconds` (see `StepReport`; "splat" includes the picture losses);
    `kernel_seconds` of the splatting kernels within a step, forward and backward; `splat_seconds`: the
    pictures of one step drawn in one traversal ("shared": colours, labels and the body alone), and by a call
    each ("separate"); `step_seconds_separate`: the step if it drew them so, by subtraction. `peak_bytes` of
    the process so far, `parameters` learned.
    """
    if config.steps < 1:
        raise UsageProblem("No steps to measure.", "steps", "Give one or more.")
    before = torch.get_num_threads()
    torch.set_num_threads(config.threads or before)
    try:
        report.step("preparing")
        trainer = prepare(subject, train)
        return measure(trainer, config.steps, report, config.update)
    finally:
        torch.set_num_threads(before)


def measure(trainer: Trainer, steps: int, report: Report, update: bool = True) -> dict[str, Any]:
    """The phases of a few late steps; without `update` only gradients are computed."""
    with nullcontext() if update else patch.object(trainer, "_update"):
        return _measure(trainer, steps, report)


def _measure(trainer: Trainer, steps: int, report: Report) -> dict[str, Any]:
    first = int(_SHARE_OF_RUN * trainer.config.steps)
    elapsed = _SHARE_OF_RUN * 60.0 * trainer.config.minutes
    report.step("steps")
    rows: list[dict[str, float]] = []
    kernels: list[dict[str, float]] = []
    with trainer.views.prefetcher.running():
        trainer.step(first, elapsed)
        for number in range(first + 1, first + 1 + steps):
            started = time.perf_counter()
            with time_kernels() as seconds:
                phases = trainer.step(number, elapsed).seconds
            rows.append({"step": time.perf_counter() - started, **phases})
            backward = sum(seconds.get(name, 0.0) for name in _BACKWARD_KERNELS)
            kernels.append({"forward": sum(seconds.values()) - backward, "backward": backward})
            report.progress(len(rows), steps)
    medians = _medians(rows)
    report.step("splatting alone")
    composite, cameras = _pictures(trainer, first)
    ways: dict[str, Draw] = {"shared": _shared}
    if BODY in composite.layers:
        ways["separate"] = _separate
    splat = _interleaved(ways, composite, cameras, steps)
    found: dict[str, Any] = {
        "gaussians": len(composite.means),
        "views": len(cameras),
        "pixels": sum(camera.width * camera.height for camera in cameras),
        "channels": composite.features.shape[1],
        "threads": torch.get_num_threads(),
        "steps": steps,
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "peak_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "step_seconds": medians.pop("step"),
        "phase_seconds": medians,
        "kernel_seconds": _medians(kernels),
        "splat_seconds": splat,
    }
    if "separate" in splat:
        more = sum(splat["separate"].values()) - sum(splat["shared"].values())
        found["step_seconds_separate"] = found["step_seconds"] + more
    return found


def _pictures(trainer: Trainer, number: int) -> tuple[Gaussians, list[Camera]]:
    """The Gaussians and the cameras of a step at full size."""
    config = trainer.config
    choice = choose(config.seed, number, trainer.frames, trainer.cameras, config.views_per_step)
    with torch.no_grad():
        composite = compose(trainer.posed(choice.frame))
    scale = config.image_scale
    return composite, [trainer.views.view(choice.frame, name, scale).camera for name in choice.cameras]


def _shared(composite: Gaussians, camera: Camera) -> list[Tensor]:
    picture = render(composite, camera, body_alone=BODY in composite.layers)
    found = [picture.color, picture.labels, picture.alpha, picture.layers[0].alpha]
    return [image for image in found if image is not None]


def _separate(composite: Gaussians, camera: Camera) -> list[Tensor]:
    """Colours, then labels, then the body alone: a call each."""
    shown = (camera.width, camera.height)
    matrices = camera.tensors(composite.means.device)

    def draw(rows: Any, channels: slice) -> Any:
        return rasterize(
            composite.means[rows], None, None, composite.opacities[rows], composite.features[rows, channels],
            *matrices, *shown, covars=composite.covariances[rows],
        )  # fmt: skip

    colors, labels = draw(slice(None), slice(3)), draw(slice(None), slice(3, None))
    body = draw(composite.layer_ids == composite.layers.index(BODY), slice(1))
    return [colors.features, labels.features, colors.alpha, body.alpha]


def _interleaved(
    ways: dict[str, Draw], composite: Gaussians, cameras: list[Camera], rounds: int
) -> dict[str, dict[str, float]]:
    """Median seconds, forward and backward, of all cameras' pictures; the ways take turns."""
    for draw in ways.values():
        _forward_backward(draw, composite, cameras)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, draw in ways.items():
            rows[name].append(_forward_backward(draw, composite, cameras))
    return {name: _medians(found) for name, found in rows.items()}


def _forward_backward(draw: Draw, composite: Gaussians, cameras: list[Camera]) -> dict[str, float]:
    names = ("means", "covariances", "opacities", "features")
    seconds = {"forward": 0.0, "backward": 0.0}
    for camera in cameras:
        leaves = {name: getattr(composite, name).detach().requires_grad_() for name in names}
        started = time.perf_counter()
        images = draw(replace(composite, **leaves), camera)
        drawn = time.perf_counter()
        torch.autograd.backward(images, [torch.ones_like(image) for image in images])
        seconds["forward"] += drawn - started
        seconds["backward"] += time.perf_counter() - drawn
    return seconds


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(row.get(name, 0.0) for row in rows) for name in rows[0]}


def step(
    subject: Subject,
    preset: Preset = "draft",
    steps: Annotated[int, typer.Option(min=1, help="Steps that are timed; medians are kept.")] = 5,
    threads: Annotated[int, typer.Option(min=0, help="0: as many as torch uses.")] = 0,
    recompute: Recompute = False,
    without_update: Annotated[
        bool,
        typer.Option(
            "--without-update",
            help="Forward and backward alone: Adam's moments take as much memory again as weights and "
            "gradients do.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure where the seconds of a training step go.

    A few late steps of a new run: networks, splatting with the picture losses, surface terms, data,
    optimiser; the splatting kernels forward and backward. Then the pictures of one step by themselves,
    colours, labels and the body alone drawn in one traversal as gw train does, and by a call each.

    The paper's networks on a machine of 16 GB: --preset paper --steps 1 --recompute --without-update.

    Needs the maps of gw bake-maps; writes nothing.
    """
    from stages.train.config import PRESETS

    console = Console(as_json)
    train = replace(preset_config(PRESETS, preset), recompute=recompute)
    console.result(run(subject, train, TimingConfig(steps, threads, not without_update), console))


app = application(step)

if __name__ == "__main__":
    app()

"""What each economy saves: a training step and a played frame, with all economies and with one left out.

Reads what `gw train` reads, and for the frames its result. Writes, into the output folder:
    economy.json: {"rows": [{"part", "without", "seconds", "peak_bytes", "slower", "psnr", …}]};
    economy.md: the same as a table.

Every row is measured by a process of its own (`gw bench economy SUBJECT --row NAME`), so that its peak memory
is its own. The first row of each part has all economies and is what the others are compared with.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, TRAIN
from stages.shared.artifacts import Workspace, write_whole
from stages.shared.artifacts.canonical import readable_json
from stages.shared.avatar.maps import LayerMaps
from stages.shared.commands import run_command
from stages.shared.errors import UsageProblem
from stages.shared.outfit.hidden import plan_hidden
from stages.shared.outfit.outfit import outfit_of_training
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.picture import take_picture
from stages.shared.outfit.player import Player
from stages.shared.report import SILENT, Report
from stages.train.config import TrainConfig
from stages.train.data import TrainingViews, View
from stages.train.stage import prepare
from stages.train.timing import TimingConfig, measure

STEP_ROWS: dict[str, str] = {
    "step": "all economies",
    "step-whole-grid": "networks and anchors see the whole grid, not the layer's window",
    "step-all-networks": "networks in every layer, also where the preset leaves them out",
    "step-pass-per-camera": "the networks run once for every camera",
    "step-separate-pictures": "colours, labels and the body alone are drawn by a call each",
    "step-whole-images": "pictures are not cropped to the subject",
    "step-nothing-saved": "none of these",
}
FRAME_ROWS: dict[str, str] = {
    "frame": "all economies",
    "frame-no-cull": "body Gaussians that nobody can see are drawn",
    "frame-plain": "posed layer by layer in torch, not by the fused kernel",
    "frame-nothing-saved": "none of these",
}
ROWS = {**STEP_ROWS, **FRAME_ROWS}
RESULT_NAME, TABLE_NAME = "economy.json", "economy.md"


@dataclass(frozen=True)
class EconomyConfig:
    """steps: of training that are timed. frames: that are played and compared with the truth."""

    steps: int = 5
    frames: int = 12


def run(
    subject: Path, output: Path, preset: str, config: EconomyConfig = EconomyConfig(), report: Report = SILENT
) -> dict[str, Any]:
    """Every row in a process of its own; the result so far is written after each.

    Raises:
        UsageProblem: nothing to measure. CommandFailed: a row failed, as the frames of an untrained subject.
    """
    if config.steps < 1 or config.frames < 1:
        raise UsageProblem("There is nothing to measure.", "options --steps and --frames", "Give more.")
    rows: list[dict[str, Any]] = []
    for index, name in enumerate(ROWS):
        report.step(ROWS[name])
        done = run_command(
            "bench", "economy", subject, "--row", name, "--preset", preset,
            "--steps", str(config.steps), "--frames", str(config.frames),
        )  # fmt: skip
        rows.append({**done.result, "peak_bytes": done.peak_bytes})
        write_results(output, rows, preset, config)
        report.progress(index + 1, len(ROWS))
    return {"path": output, "rows": compared(rows)}


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


def compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with how much slower they are, and how many dB lower, than the first of their part."""
    first = {name: row for row in rows for name in ("step", "frame") if row["row"] == name}
    found = []
    for row in rows:
        base = first[row["row"].split("-")[0]]
        more = {"slower": round(row["seconds"] / base["seconds"], 3)}
        if "psnr" in row:
            more["psnr_difference"] = round(base["psnr"] - row["psnr"], 4)
        found.append({**row, **more})
    return found


def write_results(output: Path, rows: list[dict[str, Any]], preset: str, config: EconomyConfig) -> None:
    """Result and table of the rows so far."""
    told = compared(rows)
    content = {"format": "gw-economy", "version": 1, "preset": preset, "config": asdict(config), "rows": told}
    write_whole(output / RESULT_NAME, readable_json(content))
    write_whole(output / TABLE_NAME, markdown(told).encode())


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table; `rows` as `compared` gives them."""
    lines = ["| | milliseconds | times slower | peak MB | PSNR against the truth, dB | economies cost, dB |"]
    lines.append("|---|---:|---:|---:|---:|---:|")
    for row in rows:
        psnr = f"{row['psnr']:.3f} | {-row['psnr_difference']:.3f}" if "psnr" in row else " | "
        part = row["row"].split("-")[0]
        lines.append(
            f"| {part}: {row['without']} | {1000 * row['seconds']:.1f} | {row['slower']:.2f} | "
            f"{row['peak_bytes'] / 1e6:.0f} | {psnr} |"
        )
    return "\n".join(lines) + "\n"


def _step(subject: Path, name: str, train: TrainConfig, config: EconomyConfig) -> dict[str, Any]:
    """Seconds of a late training step."""
    nothing = name == "step-nothing-saved"
    if nothing or name == "step-all-networks":
        train = replace(train, model=replace(train.model, networks="all"))
    trainer = prepare(subject, train, whole_grid if nothing or name == "step-whole-grid" else None)
    trainer.views.crops = not (nothing or name == "step-whole-images")
    trainer.one_pass = trainer.one_pass and not (nothing or name == "step-pass-per-camera")
    found = measure(trainer, TimingConfig(steps=config.steps).steps, SILENT)
    separate = nothing or name == "step-separate-pictures"
    return {
        "seconds": found["step_seconds_separate" if separate else "step_seconds"],
        "gaussians": found["gaussians"],
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "pixels": found["pixels"],
    }


def _frame(subject: Path, name: str, train: TrainConfig, config: EconomyConfig) -> dict[str, Any]:
    """Seconds of a frame from pose to pixels, and PSNR (dB) inside the masks of training pictures."""
    workspace = Workspace(subject)
    outfit = outfit_of_training(*(workspace.require(spec) for spec in (REGISTER_TEMPLATE, BAKE_MAPS, TRAIN)))
    trainer = prepare(subject, train)
    poses, shown = trainer.views.poses, _views(trainer.views, trainer.frames, trainer.cameras, config.frames)
    nothing = name == "frame-nothing-saved"
    cull = not (nothing or name == "frame-no-cull")
    hidden = plan_hidden(outfit, poses, trainer.frames) if cull else None
    player = Player(outfit, hidden=hidden)
    posed: Callable[..., Any] = outfit.composite if nothing or name == "frame-plain" else player.composite
    seconds, errors, drawn = [], [], 0
    for view in [shown[0], *shown]:
        started = time.perf_counter()
        composite = posed(poses, view.frame)
        shot = take_picture(composite, view.camera, PenetrationConfig())
        seconds.append(time.perf_counter() - started)
        inside = view.inside.numpy() > 0
        errors.append(float(np.square(shot.color - view.image.numpy())[inside].mean()))
        drawn = len(composite.means)
    return {
        "seconds": statistics.median(seconds[1:]),
        "psnr": float(np.mean([-10 * np.log10(max(error, 1e-12)) for error in errors[1:]])),
        "gaussians": drawn,
        "threads": torch.get_num_threads(),
    }


def _views(views: TrainingViews, frames: list[int], cameras: Sequence[str], count: int) -> list[View]:
    """Training pictures, spread over frames and cameras."""
    rows = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [views.view(frames[row], cameras[place % len(cameras)]) for place, row in enumerate(rows)]

"""`python -m tests.benchmarks.economy`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console
from gw_cli.options import Json, Preset, Subject, preset_config
from tests.benchmarks.command import application


def economy(
    subject: Subject,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of results.")] = Path("economy"),
    preset: Preset = "draft",
    steps: Annotated[int, typer.Option(min=1, help="Training steps that are timed per row.")] = 5,
    frames: Annotated[int, typer.Option(min=1, help="Frames that are played per row.")] = 12,
    rounds: Annotated[
        int, typer.Option(min=1, help="How often all economies and none are measured, in turns.")
    ] = 3,
    minutes: Annotated[
        float, typer.Option(min=0, help="Leave out rows that would take longer in all; 0: no limit.")
    ] = 0.0,
    row: Annotated[
        str,
        typer.Option(help="Measure this row alone, here, and write nothing: step, frame, frame-no-cull …"),
    ] = "",
    as_json: Json = False,
) -> None:
    """Measure what each economy saves, in time, memory and decibels.

    A training step and a played frame with all economies, then with one left out at a time: windows of
    the maps, networks left out, one network pass for several cameras, one traversal for all pictures,
    crops, hidden Gaussians, fused posing, the penetration pass on tile lists, frames side by side. All
    of them together against none come first, in turns, and make the summary. Every row runs in a process
    of its own. PSNR is that of training pictures, inside the masks. The frames need a trained subject.
    """
    from stages.train.config import PRESETS
    from tests.benchmarks.economy.run import EconomyConfig, measure_row, run

    console, config = Console(as_json), EconomyConfig(steps, frames, rounds, minutes)
    train = preset_config(PRESETS, preset)
    if row:
        console.result(measure_row(subject, row, train, config))
        return
    found = run(subject, output, preset, config, console)
    console.result(found, next_command=f"cat {output}/economy.md")


app = application(economy)

if __name__ == "__main__":
    app()

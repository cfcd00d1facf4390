"""`gw bench step`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json, Preset, Recompute, Subject, preset_config


def register(bench: typer.Typer) -> None:
    @bench.command("step")
    @command
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
        from stages.train.timing import TimingConfig, run

        console = Console(as_json)
        train = replace(preset_config(PRESETS, preset), recompute=recompute)
        console.result(run(subject, train, TimingConfig(steps, threads, not without_update), console))

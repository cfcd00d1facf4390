"""`gw demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Device, DryRun, Json, Preset, Seed


def register(app: typer.Typer) -> None:
    @app.command("demo")
    @command
    def demo(
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the demo.")] = Path("demo"),
        preset: Preset = "draft",
        minutes: Annotated[
            float | None, typer.Option(help="Training minutes per subject; draft takes 4.5 when absent.")
        ] = None,
        seed: Seed = 0,
        device: Device = "auto",
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Synthesise two subjects, learn both, and let one wear the other's skirt.

        Needs no input and no network. Every step is an ordinary `gw` command, shown on the page
        `index.html` in the output folder with its pictures, scores and timings. Steps that are done
        are not run again.
        """
        from stages.demo import stage
        from stages.demo.config import DemoConfig

        console = Console(as_json)
        config = DemoConfig(preset=preset, seed=seed, train_minutes=minutes, device=device)
        if dry_run:
            console.plan(stage.plan(output, config))
            return
        result = stage.run(output, config, console)
        console.result(result.summary, next_command=f"open {result.page}")

"""`gw synth`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Preset, Seed, preset_config


def register(app: typer.Typer) -> None:
    @app.command("synth")
    @command
    def synth(
        output: Annotated[Path, typer.Argument(help="Folder to write the captures to.", metavar="OUT")],
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Make two synthetic people in multi-view video, and the truth of a try-on.

        Writes OUT/subject_1 (T-shirt, flared skirt) and OUT/subject_2 (T-shirt, trousers, open vest):
        captures with images, masks, label images, body parameters and a first-frame scan, a training
        motion and another one held out. OUT/tryon_truth is subject 2 in subject 1's skirt, and
        OUT/motions/held_out.npz its motion. OUT/inner_truth is subject 2 without the vest, in some frames of
        the training motion. Garments are simulated cloth; the same seed gives the same files.
        """
        from stages.synth.config import PRESETS

        console = Console(as_json)
        config = dataclasses.replace(preset_config(PRESETS, preset), seed=seed)

        console.loading()
        from stages.synth import stage

        if dry_run:
            console.plan(stage.plan(output, config))
            return
        result = stage.run(output, config, console)
        first = result.captures["subject_1"]
        console.result(
            {"captures": result.captures, "motion": result.motion, **result.summary},
            next_command=("gw", "register-template", first, "-o", output / "wardrobe" / first.name),
        )

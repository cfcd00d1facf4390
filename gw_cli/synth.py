"""`gw synth`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json
from stages.synth.config import PRESETS, SynthConfig


def register(app: typer.Typer) -> None:
    @app.command("synth")
    @command
    @config_options(PRESETS, "draft")
    def synth(
        output: Annotated[Path, typer.Argument(help="Folder to write the captures to.", metavar="OUT")],
        config: SynthConfig = PRESETS["draft"],
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
        console = Console(as_json)
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

"""`gw fit-cloth`."""

from __future__ import annotations

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of, export_command
from gw_cli.options import DryRun, Force, Json, Subject
from stages.fit_cloth.config import PRESETS, FitClothConfig


def register(app: typer.Typer) -> None:
    @app.command("fit-cloth")
    @command
    @config_options(PRESETS, "draft")
    def fit_cloth(
        subject: Subject,
        config: FitClothConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Make the garments of a trained subject ready for cloth simulation.

        Every garment gets a simulation mesh, pins and a material. The material is the one that follows the
        tracked garment best. Bones, learned offsets and simulation are compared in parts of the take that
        were left out. The best of them becomes what `--drive auto` means for the garment.
        """
        console = Console(as_json)
        check_inputs_of("fit-cloth", subject)
        console.loading()
        from stages.fit_cloth import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, export_command(subject))

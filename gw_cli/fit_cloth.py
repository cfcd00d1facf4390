"""`gw fit-cloth`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of, export_command
from gw_cli.options import DryRun, Force, Json, Preset, Subject, preset_config


def register(app: typer.Typer) -> None:
    @app.command("fit-cloth")
    @command
    def fit_cloth(
        subject: Subject,
        materials: Annotated[
            str, typer.Option(help="Materials to try, separated by commas; the preset's by default.")
        ] = "",
        vertices: Annotated[int, typer.Option(help="Vertices of each simulation mesh, 0: the preset's.")] = 0,
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Make the garments of a trained subject ready for cloth simulation.

        Every garment gets a simulation mesh, pins and a material. The material is the one that follows the
        tracked garment best. Bones, learned offsets and simulation are compared in parts of the take that
        were left out. The best of them becomes what `--drive auto` means for the garment.
        """
        from stages.fit_cloth.config import PRESETS

        console = Console(as_json)
        config = preset_config(PRESETS, preset)
        if materials:
            config = replace(config, materials=tuple(name.strip() for name in materials.split(",")))
        if vertices:
            config = replace(config, vertices=vertices)
        check_inputs_of("fit-cloth", subject)
        console.loading()
        from stages.fit_cloth import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, export_command(subject))

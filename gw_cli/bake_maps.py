"""`gw bake-maps`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Preset, Subject, preset_config
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("bake-maps")
    @command
    def bake_maps(
        subject: Subject,
        pitch: Annotated[
            float | None, typer.Option(help="Millimetres per texel; the preset's if left out.")
        ] = None,
        extent: Annotated[
            float | None, typer.Option(help="Side of the square map, metres; everything must fit.")
        ] = None,
        sheets: Annotated[
            int | None,
            typer.Option(
                min=0, max=15, help="Most sheets a side for hidden surfaces; 0: front and back only."
            ),
        ] = None,
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Turn every layer into front and back maps of texels; each texel will carry one Gaussian.

        All layers and subjects share one grid, so the same texel is the same place on everybody.
        Layers whose two views leave more than 1 % unseen get further sheets for what lies behind.
        """
        from stages.bake_maps.config import PRESETS

        console = Console(as_json)
        config = preset_config(PRESETS, preset)
        if pitch is not None:
            config = replace(config, pitch=_within("--pitch", pitch, 0.5, 200.0) / 1000)
        if extent is not None:
            config = replace(config, extent_m=_within("--extent", extent, 0.5, 10.0))
        if sheets is not None:
            config = replace(config, most_sheets=sheets)
        check_inputs_of("bake-maps", subject)

        from stages.bake_maps import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=f"gw train {subject}")


def _within(option: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise UsageProblem(
            f"{value:g} is out of range.", f"option {option}", f"Give a number from {low:g} to {high:g}."
        )
    return value

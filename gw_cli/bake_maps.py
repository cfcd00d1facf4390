"""`gw bake-maps`."""

from __future__ import annotations

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Subject
from stages.bake_maps.config import PRESETS, BakeMapsConfig


def register(app: typer.Typer) -> None:
    @app.command("bake-maps")
    @command
    @config_options(PRESETS, "draft")
    def bake_maps(
        subject: Subject,
        config: BakeMapsConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Turn every layer into front and back maps of texels; each texel will carry one Gaussian.

        All layers and subjects share one grid, so the same texel is the same place on everybody. Layers whose
        two views leave more than 1 % unseen get further sheets for what lies behind.
        """
        console = Console(as_json)
        check_inputs_of("bake-maps", subject)

        console.loading()
        from stages.bake_maps import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=("gw", "train", subject))

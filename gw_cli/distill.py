"""`gw distill`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of, check_poses
from gw_cli.options import DryRun, Force, Json, Preset, Subject, parse_ranks, preset_config


def register(app: typer.Typer) -> None:
    @app.command("distill")
    @command
    def distill(
        subject: Subject,
        poses: Annotated[
            list[Path] | None,
            typer.Option("--poses", help="Motions beyond the training's to be faithful in; repeatable."),
        ] = None,
        ranks: Annotated[
            str, typer.Option(help="At most so many bases for offsets, colours and form, e.g. 16,6,4.")
        ] = "",
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Turn the trained networks into blendshapes that play in real time.

        The networks are asked about the training poses and poses between them; bases per texel, with a kernel
        on the pose, take over what they answered. `gw render` and `gw export-garment` use the result with
        `--distilled`, `gw evaluate` with `--methods distilled`; bundles made so are worn like any other.
        """
        from stages.distill.config import PRESETS

        console = Console(as_json)
        config = preset_config(PRESETS, preset)
        if ranks:
            config = replace(config, most=parse_ranks(ranks))
        check_inputs_of("distill", subject)
        check_poses(poses or ())

        from stages.distill import stage

        if dry_run:
            console.plan(stage.plan(subject, config, poses or ()))
            return
        result = stage.run(subject, config, console, force, tuple(poses or ()))
        following = f"gw export-garment {subject} --layer body --distilled -o body.gwg"
        console.result(result.summary, next_command=following)

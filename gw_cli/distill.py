"""`gw distill`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of, check_poses
from gw_cli.options import DryRun, Force, Json, Subject
from stages.distill.config import PRESETS, DistillConfig


def register(app: typer.Typer) -> None:
    @app.command("distill")
    @command
    @config_options(PRESETS, "draft")
    def distill(
        subject: Subject,
        poses: Annotated[
            list[Path] | None,
            typer.Option("--poses", help="Further motions in which the result must be faithful; repeatable."),
        ] = None,
        config: DistillConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Turn the trained networks into blendshapes that play in real time.

        The networks are evaluated in the training poses and in poses between them. Bases per texel, with a
        kernel on the pose, replace the networks. `gw render` and `gw export-garment` use the result with
        `--distilled`, `gw evaluate` with `--methods distilled`. Bundles made from it are worn like any other.
        """
        console = Console(as_json)
        check_inputs_of("distill", subject)
        check_poses(poses or ())

        console.loading()
        from stages.distill import stage

        if dry_run:
            console.plan(stage.plan(subject, config, poses or ()))
            return
        result = stage.run(subject, config, console, force, tuple(poses or ()))
        following = ("gw", "export-garment", subject, "--layer", "body", "--distilled", "-o", "body.gwg")
        console.result(result.summary, next_command=following)

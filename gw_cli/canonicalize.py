"""`gw canonicalize`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Preset, one_of, preset_config
from stages.shared.errors import UsageProblem
from stages.shared.plan import Plan


def register(app: typer.Typer) -> None:
    @app.command("canonicalize")
    @command
    def canonicalize(
        given: Annotated[
            Path, typer.Argument(metavar="SUBJECT", help="Workspace folder of the subject, or one mesh file.")
        ],
        output: Annotated[
            Path | None,
            typer.Option("--output", "-o", help="For a mesh: workspace to make; default: its name."),
        ] = None,
        params: Annotated[
            Path | None, typer.Option(help="For a mesh: its body fit (smpl_params.npz); fitted if left out.")
        ] = None,
        body_model: Annotated[
            Path | None, typer.Option(help="For a mesh: body model (.npz, SMPL-X convention).")
        ] = None,
        spread: Annotated[
            str | None,
            typer.Option(
                help="wide | inverse | undiffused | nearest: how skinning weights reach into space."
            ),
        ] = None,
        shape_removal: Annotated[
            str, typer.Option(help="exact | paper: whether joints move with the shape that is taken out.")
        ] = "exact",
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Bring the template to the canonical pose and the zero shape.

        Every vertex keeps the skinning weights that pose it back exactly. A lone mesh is registered first:
        with --params the body fit is given, without it the body is fitted to the mesh.
        """
        from stages.canonicalize.config import PRESETS, SHAPE_REMOVALS, SPREADS

        console = Console(as_json)
        config = preset_config(PRESETS, preset)
        if spread is not None:
            config = replace(config, spread=one_of("--spread", spread, SPREADS))
        config = replace(config, shape_removal=one_of("--shape-removal", shape_removal, SHAPE_REMOVALS))
        subject = given
        if given.is_file():
            subject = output or Path(given.stem)
            if dry_run:
                console.plan(_plan_mesh(given, subject, preset, body_model, params))
                return
            _register_mesh(given, subject, preset, body_model, params, console, force)
        elif output is not None or params is not None or body_model is not None:
            raise UsageProblem(
                "--output, --params and --body-model are for a lone mesh.",
                str(given),
                "Leave them out: a workspace has its own; gw register-template sets them.",
            )
        if not given.is_file():
            check_inputs_of("canonicalize", subject)

        from stages.canonicalize import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=f"gw segment-layers {subject}")


def _register_mesh(
    mesh: Path,
    subject: Path,
    preset: str,
    body_model: Path | None,
    params: Path | None,
    console: Console,
    force: bool,
) -> None:
    from stages.register_template import stage
    from stages.register_template.config import PRESETS

    config = preset_config(PRESETS, preset)
    stage.run(mesh, subject, config, console, body_model=body_model, params=params, force=force)


def _plan_mesh(mesh: Path, subject: Path, preset: str, body_model: Path | None, params: Path | None) -> Plan:
    from stages.register_template import stage
    from stages.register_template.config import PRESETS

    return stage.plan(mesh, subject, preset_config(PRESETS, preset), body_model=body_model, params=params)

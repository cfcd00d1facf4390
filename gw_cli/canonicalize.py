"""`gw canonicalize`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Preset
from stages.canonicalize.config import PRESETS, CanonicalizeConfig
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("canonicalize")
    @command
    @config_options(PRESETS, "draft")
    def canonicalize(
        source: Annotated[
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
        config: CanonicalizeConfig = PRESETS["draft"],
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Bring the template to the canonical pose and the zero shape.

        Every vertex keeps the skinning weights that pose it back exactly. A lone mesh is registered first:
        with --params its body fit is used, without it the body is fitted to the mesh.
        """
        console = Console(as_json)
        subject = source
        if source.is_file():
            from stages.register_template import stage as registration
            from stages.register_template.config import PRESETS as REGISTRATIONS

            subject = output or Path(source.stem)
            registered = REGISTRATIONS[preset]
            if dry_run:
                console.plan(registration.plan(source, subject, registered, body_model, params))
                return
            registration.run(source, subject, registered, console, body_model, params, force=force)
        elif output is not None or params is not None or body_model is not None:
            raise UsageProblem(
                "--output, --params and --body-model are for a lone mesh.",
                str(source),
                "Leave them out: a workspace has its own; gw register-template sets them.",
            )
        else:
            check_inputs_of("canonicalize", subject)

        console.loading()
        from stages.canonicalize import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=("gw", "segment-layers", subject))

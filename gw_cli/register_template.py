"""`gw register-template`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists
from gw_cli.options import DryRun, Force, Json
from stages.register_template.config import PRESETS, RegisterTemplateConfig
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("register-template")
    @command
    @config_options(PRESETS, "draft")
    def register_template(
        source: Annotated[
            Path,
            typer.Argument(metavar="CAPTURE", help="Folder of a capture, or one mesh of a dressed person."),
        ],
        subject: Annotated[Path, typer.Option("--output", "-o", help="Workspace folder of the subject.")],
        body_model: Annotated[
            Path | None,
            typer.Option(help="Body model of the poses (.npz); default: the capture's."),
        ] = None,
        params: Annotated[Path | None, typer.Option(help="Body fit of a mesh (smpl_params.npz).")] = None,
        fit: Annotated[
            bool,
            typer.Option("--fit", help="Find the poses from masks (and the scan, if it is the template)."),
        ] = False,
        refine: Annotated[
            bool, typer.Option("--refine", help="Improve the capture's poses by masks (and the scan).")
        ] = False,
        fit_body_model: Annotated[
            Path | None,
            typer.Option(help="Model the poses were fitted with (gendered), if not --body-model: converted."),
        ] = None,
        hold_out: Annotated[
            list[str] | None,
            typer.Option(
                metavar="CAMERA", help="Do not learn from this camera: judge novel views by it. Repeatable."
            ),
        ] = None,
        capture_format: Annotated[str | None, typer.Option("--format", help="Layout of the capture.")] = None,
        config: RegisterTemplateConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Check that body and masks fit, and get the dressed surface of one frame.

        The body of the poses is projected into the masks; if it does not fit, the command refuses and says
        what it tried. The picture SUBJECT/register-template/*/overlay.png shows the fit. Without poses --fit
        finds them: gw register-template CAPTURE -o SUBJECT --fit. A lone mesh is cleaned (unit, up axis,
        faces inside out, doubled vertices), and the body is fitted into it.
        """
        console = Console(as_json)
        if fit and refine:
            raise UsageProblem(
                "Poses are either found or improved.", "--fit --refine", "Give one of the two."
            )
        poses = "fit" if fit else "refine" if refine else "given"
        config = replace(config, poses=poses, hold_out=tuple(hold_out or ()))
        check_exists(source, "capture or mesh")

        console.loading()
        from stages.register_template import stage

        if dry_run:
            console.plan(
                stage.plan(source, subject, config, body_model, params, capture_format, fit_body_model)
            )
            return
        result = stage.run(
            source, subject, config, console, body_model, params, capture_format, force, fit_body_model
        )
        console.result(result.summary, next_command=("gw", "canonicalize", subject))

"""`gw register-template`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_exists
from gw_cli.options import DryRun, Force, Json, Preset, preset_config


def register(app: typer.Typer) -> None:
    @app.command("register-template")
    @command
    def register_template(
        given: Annotated[
            Path,
            typer.Argument(metavar="CAPTURE", help="Folder of a capture, or one mesh of a dressed person."),
        ],
        subject: Annotated[Path, typer.Option("--output", "-o", help="Workspace folder of the subject.")],
        template: Annotated[
            str,
            typer.Option(help="auto | scan | hull (of the masks) | body (bare)."),
        ] = "auto",
        frame: Annotated[
            int | None, typer.Option(help="Frame of the template; chosen by its pose if left out.")
        ] = None,
        take: Annotated[str | None, typer.Option(help="Training take of the template.")] = None,
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
        virtual_cameras: Annotated[
            int,
            typer.Option(
                min=0, max=64, help="Cameras rendered around the scans of every frame (4D-DRESS: 12)."
            ),
        ] = 0,
        hold_out: Annotated[
            list[str] | None,
            typer.Option(
                metavar="CAMERA", help="Do not learn from this camera: judge novel views by it. Repeatable."
            ),
        ] = None,
        capture_format: Annotated[str | None, typer.Option("--format", help="Layout of the capture.")] = None,
        preset: Preset = "draft",
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
        from stages.register_template.config import PRESETS
        from stages.shared.errors import UsageProblem

        console = Console(as_json)
        if fit and refine:
            raise UsageProblem(
                "Poses are either found or improved.", "--fit --refine", "Give one of the two."
            )
        poses = "fit" if fit else "refine" if refine else "given"
        config = replace(
            preset_config(PRESETS, preset),
            template=template,
            frame=frame,
            take=take,
            poses=poses,
            virtual_cameras=virtual_cameras,
            hold_out=tuple(hold_out or ()),
        )
        check_exists(given, "capture or mesh")

        from stages.register_template import stage

        if dry_run:
            console.plan(
                stage.plan(given, subject, config, body_model, params, capture_format, fit_body_model)
            )
            return
        result = stage.run(
            given, subject, config, console, body_model, params, capture_format, force, fit_body_model
        )
        console.result(result.summary, next_command=f"gw canonicalize {subject}")

"""`gw import`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json
from stages.import_capture.config import PRESETS, ImportConfig
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("import")
    @command
    @config_options(PRESETS)
    def import_capture(
        source: Annotated[
            Path,
            typer.Argument(
                metavar="SOURCE", help="Folder with a video, a folder of pictures or a picture a camera."
            ),
        ],
        output: Annotated[
            Path, typer.Option("--output", "-o", help="Folder of the capture that is written.")
        ],
        calibration: Annotated[
            Path | None, typer.Option(help="Calibration file or folder; default: looked for in SOURCE.")
        ] = None,
        frames: Annotated[str, typer.Option(help="Only these frames, as a slice: 10:200:2.")] = "",
        offset: Annotated[
            list[str] | None,
            typer.Option(help="CAMERA=SECONDS by which its recording begins later; may be repeated."),
        ] = None,
        config: ImportConfig = PRESETS["draft"],
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Make a capture of videos or pictures and a calibration.

        Lens distortion is removed, the world is brought to metres and y up, and masks are made where there
        are none. Look at CAPTURE/contact_sheet.png: it shows the cameras and a picture of each with its
        mask.
        """
        console = Console(as_json)
        config = replace(config, frames=_slice(frames), offsets=dict(_offset(text) for text in offset or ()))
        console.loading()
        from stages.import_capture import stage

        if dry_run:
            console.plan(stage.plan(source, output, config, calibration))
            return
        result = stage.run(source, output, config, console, calibration)
        console.result(
            result.summary, next_command=("gw", "register-template", output, "-o", "SUBJECT", "--fit")
        )


def _slice(text: str) -> tuple[int, int | None, int]:
    parts = text.split(":")
    try:
        values = [int(part) if part else None for part in parts] + [None] * (3 - len(parts))
        start, stop, step = values[0] or 0, values[1], values[2] or 1
        if len(parts) > 3 or start < 0 or step < 1 or (stop is not None and stop <= start):
            raise ValueError(text)
    except ValueError as error:
        raise UsageProblem("This is no slice of frames.", f"--frames {text}", "Write 10:200:2.") from error
    return start, stop, step


def _offset(text: str) -> tuple[str, float]:
    name, _, seconds = text.rpartition("=")
    try:
        return name, float(seconds)
    except ValueError as error:
        raise UsageProblem("This is no offset.", f"--offset {text}", "Write cam02=0.35.") from error

"""`gw label`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_inputs_of
from gw_cli.options import DryRun, Force, Json, Subject
from stages.label.config import PRESETS, LabelConfig


def register(app: typer.Typer) -> None:
    @app.command("label")
    @command
    @config_options(PRESETS)
    def label(
        subject: Subject,
        strokes: Annotated[
            Path | None, typer.Option(help="JSON file of strokes that correct the guess (docs/formats.md).")
        ] = None,
        config: LabelConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Guess which surface is skin, hair, shoe, upper or lower garment, where nothing tells.

        For a capture without label images. The fitted body says where a label is likely, face and hands show
        the colour of the skin, and a graph cut finds the borders. Strokes correct it. Only the frame of the
        template is labelled; the stages that follow read these labels in place of the capture's.
        """
        from stages.label.strokes import read_strokes

        console = Console(as_json)
        check_exists(strokes, "stroke file")
        check_inputs_of("label", subject)
        if strokes is not None:
            config = replace(config, strokes=read_strokes(strokes))

        console.loading()
        from stages.label import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=("gw", "canonicalize", subject))

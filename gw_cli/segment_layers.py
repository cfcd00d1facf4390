"""`gw segment-layers`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Preset, Subject, one_of, preset_config

_LABELS = ("auto", "images", "scan")


def register(app: typer.Typer) -> None:
    @app.command("segment-layers")
    @command
    def segment_layers(
        subject: Subject,
        labels: Annotated[
            str, typer.Option(help="auto | images | scan: vote of the label images, or labels of the scan.")
        ] = "auto",
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Split the template into the body and the garments that are there, and give them colours.

        Labels come from the label images of the template's frame (every camera votes where it sees the
        surface) or from the scan. The body is the whole body model, with the hair and shoes of the template.
        """
        from stages.segment_layers.config import PRESETS

        console = Console(as_json)
        config = replace(preset_config(PRESETS, preset), labels=one_of("--labels", labels, _LABELS))
        check_inputs_of("segment-layers", subject)

        from stages.segment_layers import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=f"gw bake-maps {subject}")

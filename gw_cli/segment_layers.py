"""`gw segment-layers`."""

from __future__ import annotations

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_inputs_of
from gw_cli.options import DryRun, Force, Json, Subject
from stages.segment_layers.config import PRESETS, SegmentLayersConfig


def register(app: typer.Typer) -> None:
    @app.command("segment-layers")
    @command
    @config_options(PRESETS, "draft")
    def segment_layers(
        subject: Subject,
        config: SegmentLayersConfig = PRESETS["draft"],
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Split the template into the body and the garments that are there, and give them colours.

        Labels come from the label images of the template's frame (every camera votes where it sees the
        surface) or from the scan. The body is the whole body model, with the hair and shoes of the template.
        """
        console = Console(as_json)
        check_inputs_of("segment-layers", subject)

        console.loading()
        from stages.segment_layers import stage

        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console, force)
        console.result(result.summary, next_command=("gw", "bake-maps", subject))

"""`gw canonicalize`."""

from __future__ import annotations

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Force, Json, Preset, Subject, preset_config


def register(app: typer.Typer) -> None:
    @app.command("canonicalize")
    @command
    def canonicalize(
        subject: Subject,
        preset: Preset = "draft",
        force: Force = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Bring the template to the canonical, zero-shape space (example of how a command is written)."""
        from stages.canonicalize import stage
        from stages.canonicalize.config import PRESETS

        console = Console(as_json)
        config = preset_config(PRESETS, preset)
        if dry_run:
            console.plan(stage.plan(subject, config))
            return
        result = stage.run(subject, config, console)
        console.result(result.summary, next_command=f"gw segment-layers {subject}")

"""`gw status`: what is up to date, what is not, and why."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from typing import Annotated, Any

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json, Subject, preset_config


def register(app: typer.Typer) -> None:
    @app.command("status")
    @command
    def status(
        subject: Subject,
        preset: Annotated[
            str | None, typer.Option(help="Compare with this preset too: tiny | draft | balanced | paper.")
        ] = None,
        as_json: Json = False,
    ) -> None:
        """Show the state of every stage of a subject, why it is stale, and the command to run next.

        A stage is stale when a file it read has changed, when a stage before it is stale or was made again,
        or when its code is newer. Nothing is computed or changed.
        """
        from stages.pipeline import OPTIONAL, PIPELINE
        from stages.shared.artifacts.staleness import next_stage, staleness
        from stages.shared.artifacts.workspace import Workspace
        from stages.shared.errors import MissingInput

        if not subject.is_dir():
            raise MissingInput(
                "There is no such subject.",
                str(subject),
                f"Make it: gw register-template CAPTURE -o {subject}",
            )
        workspace = Workspace(subject)
        configs = {} if preset is None else {spec.name: _preset(spec.name, preset) for spec in PIPELINE}
        made = tuple(spec for spec in OPTIONAL if workspace.current(spec) is not None)
        states = staleness(workspace, PIPELINE + made, configs)
        following = next_stage(states, PIPELINE)
        next_command = None if following is None else workspace.command(following)

        console = Console(as_json)
        if as_json:
            console.result({"stages": [dataclasses.asdict(state) for state in states], "next": next_command})
            return
        width = max(len(spec.name) for spec in PIPELINE)
        for state in states:
            first, *others = state.reasons or [""]
            console.say(f"{state.stage:{width}}  {state.state:10}  {first}".rstrip())
            for reason in others:
                console.say(" " * (width + 14) + reason)
        console.result({}, next_command)


def _preset(stage: str, preset: str) -> Any:
    """The configuration that a preset gives a stage."""
    module = importlib.import_module(f"stages.{stage.replace('-', '_')}.config")
    return preset_config(module.PRESETS, preset)

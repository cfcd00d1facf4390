"""`gw status`: what is up to date, what is not, and why."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json, Subject, known_preset, preset_config

if TYPE_CHECKING:
    from stages.shared.artifacts.workspace import Workspace


def register(app: typer.Typer) -> None:
    @app.command("status")
    @command
    def status(
        subject: Subject,
        preset: Annotated[
            str | None,
            typer.Option(
                help="Compare with this preset too: tiny | draft | balanced | paper.", callback=known_preset
            ),
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
            rows = [{**dataclasses.asdict(state), **_cost(workspace, state.stage)} for state in states]
            console.result({"stages": rows, "next": next_command})
            return
        width = max(len(spec.name) for spec in PIPELINE)
        for state in states:
            first, *others = state.reasons or [_spent(_cost(workspace, state.stage))]
            console.say(f"{state.stage:{width}}  {state.state:10}  {first}".rstrip())
            for reason in others:
                console.say(" " * (width + 14) + reason)
        console.result({}, next_command)


def _cost(workspace: Workspace, stage: str) -> dict[str, float | None]:
    """Seconds and peak bytes of the run that made a stage's artifact; None where there is no record."""
    from stages.pipeline import BY_NAME
    from stages.shared.errors import BadData

    try:
        artifact = workspace.current(BY_NAME[stage])
        record = {} if artifact is None else artifact.run
    except BadData:
        record = {}
    return {name: record.get(name) for name in ("seconds", "peak_bytes")}


def _spent(cost: dict[str, float | None]) -> str:
    seconds, peak = cost["seconds"], cost["peak_bytes"]
    return "" if seconds is None or peak is None else f"took {seconds:.1f} s and {peak / 1e9:.2f} GB"


def _preset(stage: str, preset: str) -> Any:
    """The configuration that a preset gives a stage."""
    module = importlib.import_module(f"stages.{stage.replace('-', '_')}.config")
    return preset_config(module.PRESETS, preset)

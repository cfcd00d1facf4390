"""`gw bench tradeoff`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gw_cli.completion import PRESETS
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists
from gw_cli.options import DryRun, Json, Preset, Seed, names
from stages.shared.errors import UsageProblem

if TYPE_CHECKING:
    from stages.workflows.tradeoff.config import Training


def register(bench: typer.Typer) -> None:
    @bench.command("tradeoff")
    @command
    def tradeoff(
        capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture with held-out cameras.")],
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of results.")] = Path("tradeoff"),
        minutes: Annotated[
            float, typer.Option(min=0.1, help="Of training, over all pitches together.")
        ] = 24.0,
        pitches: Annotated[
            str, typer.Option(help="Millimetres per texel, each trained once; default 6.5,9,13,20.")
        ] = "",
        also: Annotated[
            str,
            typer.Option(
                metavar="PRESET:MINUTES,…",
                help="Train whole presets too, each at its own pitch: balanced:12,tiny:1.",
            ),
        ] = "",
        body_model: Annotated[Path | None, typer.Option(help="As in gw register-template.")] = None,
        size: Annotated[
            int, typer.Option(min=16, max=4096, help="Pixels of the pictures that are timed.")
        ] = 512,
        trained_blendshapes: Annotated[
            bool,
            typer.Option(
                "--trained-blendshapes",
                help="Also train blendshapes by themselves; they get half of the minutes.",
            ),
        ] = False,
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Measure the trade of speed for accuracy on one capture, and draw its front.

        For every pitch the subject is trained once; it and blendshapes
        distilled from it are then played, scored and weighed. `gw tryon --tradeoff FOLDER --fps 25` or
        `--quality 0.3` choose among the points.
        """
        from stages.workflows.tradeoff.config import TRAINED_BLENDSHAPES, BenchTradeoffConfig

        console = Console(as_json)
        config = BenchTradeoffConfig(minutes=minutes, preset=preset, size=size, seed=seed)
        if pitches:
            config = replace(config, pitches=_pitches(pitches))
        if trained_blendshapes:
            config = replace(config, decoders=(*config.decoders, TRAINED_BLENDSHAPES))
        if also:
            config = replace(config, also=_trainings(also))
        check_exists(capture)
        check_exists(body_model, "body model")

        from gw_cli.child import run_command
        from stages.workflows.tradeoff import stage

        if dry_run:
            console.plan(stage.plan(capture, output, config, run_command, body_model))
            return
        result = stage.run(capture, output, config, run_command, console, body_model)
        console.result({"path": result.path, **result.summary})


def _trainings(text: str) -> tuple[Training, ...]:
    from stages.workflows.tradeoff.config import Training

    found = []
    for part in names(text):
        preset, _, minutes = part.partition(":")
        if preset not in PRESETS or not minutes.replace(".", "", 1).isdigit() or not float(minutes):
            raise UsageProblem(
                f"{part!r} is no preset with minutes.", "option --also", "Give for example balanced:12."
            )
        found.append(Training(preset, float(minutes)))
    return tuple(found)


def _pitches(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in names(text))
    except ValueError:
        raise UsageProblem(
            f"{text!r} are no pitches.", "option --pitches", "Give millimetres, as 6.5,13."
        ) from None

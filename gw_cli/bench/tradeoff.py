"""`gw bench tradeoff`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import PRESETS
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists
from gw_cli.options import DryRun, Json, Preset, Seed, names
from stages.shared.errors import UsageProblem
from stages.workflows.tradeoff.config import TRAINED_BLENDSHAPES, BenchTradeoffConfig, Training


def register(bench: typer.Typer) -> None:
    @bench.command("tradeoff")
    @command
    @config_options({"tradeoff": BenchTradeoffConfig()})
    def tradeoff(
        capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture with held-out cameras.")],
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of results.")] = Path("tradeoff"),
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
        body_model: Annotated[
            Path | None, typer.Option(help="Body model of the poses (.npz); default: the capture's.")
        ] = None,
        trained_blendshapes: Annotated[
            bool,
            typer.Option(
                "--trained-blendshapes",
                help="Also train blendshapes by themselves; they get half of the minutes.",
            ),
        ] = False,
        config: BenchTradeoffConfig = BenchTradeoffConfig(),
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Measure the trade of speed for accuracy on one capture, and draw its front.

        The subject is trained once for every pitch. The training and the blendshapes distilled from it are
        then played and scored, and their size is measured. `gw tryon --tradeoff FOLDER` with `--fps 25` or
        `--quality 0.3` chooses among the points.
        """
        console = Console(as_json)
        config = replace(config, preset=preset, seed=seed)
        if pitches:
            config = replace(config, pitches=_pitches(pitches))
        if trained_blendshapes:
            config = replace(config, decoders=(*config.decoders, TRAINED_BLENDSHAPES))
        if also:
            config = replace(config, also=_trainings(also))
        check_exists(capture)
        check_exists(body_model, "body model")

        console.loading()
        from gw_cli.child import run_command
        from stages.workflows.tradeoff import stage

        if dry_run:
            console.plan(stage.plan(capture, output, config, run_command, body_model))
            return
        result = stage.run(capture, output, config, run_command, console, body_model)
        console.result({"path": result.path, **result.summary})


def _trainings(text: str) -> tuple[Training, ...]:
    trainings = []
    for part in names(text):
        preset, _, minutes = part.partition(":")
        if preset not in PRESETS or not minutes.replace(".", "", 1).isdigit() or not float(minutes):
            raise UsageProblem(
                f"{part!r} is no preset with minutes.", "option --also", "Give for example balanced:12."
            )
        trainings.append(Training(preset, float(minutes)))
    return tuple(trainings)


def _pitches(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in names(text))
    except ValueError:
        raise UsageProblem(
            f"{text!r} are no pitches.", "option --pitches", "Give millimetres, as 6.5,13."
        ) from None

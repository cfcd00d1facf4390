"""`gw render`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import (
    Background,
    Betas,
    Distilled,
    DryRun,
    FilmFolder,
    FrameRate,
    Json,
    Passes,
    Penetration,
    Pixels,
    Preset,
    Rows,
    Swap,
    names,
    preset_config,
)


def register(app: typer.Typer) -> None:
    @app.command("render")
    @command
    def render(
        sources: Annotated[
            list[Path], typer.Argument(metavar="SUBJECT|BODY.gwg …", help="A trained subject, or bundles.")
        ],
        poses: Annotated[
            Path | None, typer.Option(help="The motion; default: the subject's own, or the capture's.")
        ] = None,
        cameras: Annotated[
            Path | None, typer.Option(help="A capture: its cameras, for the frames it has images of.")
        ] = None,
        output: FilmFolder = Path("render"),
        camera: Annotated[
            str, typer.Option(help="static | orbit; with --cameras the name of one camera.")
        ] = "",
        take: Annotated[str, typer.Option(help="With --cameras: which take of the capture.")] = "",
        distilled: Distilled = False,
        layers: Annotated[str, typer.Option(help="Only these layers, e.g. body,lower.")] = "",
        betas: Betas = "",
        frames: Rows = "",
        fps: FrameRate = 0.0,
        width: Pixels = None,
        height: Pixels = None,
        background: Background = "white",
        passes: Passes = "",
        swap: Swap = True,
        penetration: Penetration = True,
        preset: Preset = "draft",
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Write film and frames of a subject, or of an outfit of bundles.

        Frames have a transparent background; the film plays in a browser. With --cameras the frames can be
        scored: gw evaluate --frames OUT --truth CAPTURE.
        """
        from stages.render import stage
        from stages.render.config import PRESETS

        console = Console(as_json)
        base = preset_config(PRESETS, preset)
        config = replace(
            base,
            betas=betas,
            frames=frames,
            fps=fps,
            camera=camera,
            take=take,
            width=width or base.width,
            height=height or base.height,
            background=background,
            distilled=distilled,
            layers=names(layers),
            passes=names(passes),
            swap=swap,
            penetration=penetration,
        )
        if dry_run:
            console.plan(stage.plan(sources, poses, cameras, output, config))
            return
        result = stage.run(sources, poses, cameras, output, config, console)
        score = f"gw evaluate --frames {result.path} --truth {cameras}" if cameras else None
        console.result({"path": result.path, **result.summary}, next_command=score)

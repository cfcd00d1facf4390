"""`gw render`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Preset, preset_config


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
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of film and frames.")] = Path(
            "render"
        ),
        camera: Annotated[
            str, typer.Option(help="static | orbit; with --cameras the name of one camera.")
        ] = "",
        take: Annotated[str, typer.Option(help="With --cameras: which take of the capture.")] = "",
        layers: Annotated[str, typer.Option(help="Only these layers, e.g. body,lower.")] = "",
        betas: Annotated[str, typer.Option(help="Another body shape: up to ten numbers, 0.5,-1.2.")] = "",
        frames: Annotated[str, typer.Option(help="Only these rows of the motion, as a slice: 10:90:2.")] = "",
        fps: Annotated[float, typer.Option(min=0, help="Frames per second; 0 keeps the motion's own.")] = 0.0,
        width: Annotated[int | None, typer.Option(min=16, max=8192, help="Pixels.")] = None,
        height: Annotated[int | None, typer.Option(min=16, max=8192, help="Pixels.")] = None,
        background: Annotated[str, typer.Option(help="white | black | grey | #rrggbb.")] = "white",
        passes: Annotated[str, typer.Option(help="Also write: labels,depth,layers.")] = "",
        swap: Annotated[
            bool, typer.Option(help="Beneath a garment, give the body the form of the garment's source.")
        ] = True,
        penetration: Annotated[
            bool, typer.Option(help="Repair pixels where an inner layer pokes through a garment.")
        ] = True,
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
            layers=_names(layers),
            passes=_names(passes),
            swap=swap,
            penetration=penetration,
        )
        if dry_run:
            console.plan(stage.plan(sources, poses, cameras, output, config))
            return
        result = stage.run(sources, poses, cameras, output, config, console)
        score = f"gw evaluate --frames {result.path} --truth {cameras}" if cameras else None
        console.result({"path": result.path, **result.summary}, next_command=score)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())

"""`gw tryon`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import (
    Background,
    Betas,
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
    @app.command("tryon")
    @command
    def tryon(
        bundles: Annotated[
            list[Path], typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="One body and its garments.")
        ],
        poses: Annotated[Path, typer.Option(help="The motion: npz of SMPL-X or AMASS, or BVH.")],
        output: FilmFolder = Path("tryon"),
        betas: Betas = "",
        camera: Annotated[str, typer.Option(help="static | orbit.")] = "static",
        frames: Rows = "",
        fps: FrameRate = 0.0,
        width: Pixels = None,
        height: Pixels = None,
        background: Background = "white",
        passes: Passes = "",
        swap: Swap = True,
        restore: Annotated[
            bool, typer.Option(help="Let skin that clothes used to cover look like the skin around.")
        ] = True,
        push: Annotated[bool, typer.Option(help="Let garments give way where the body is larger.")] = False,
        penetration: Penetration = True,
        preset: Preset = "draft",
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Let a body wear garments of other people, in a new motion.

        Which garment lies over which follows from the layers (body < lower < upper < outer), not from the
        order they are named in. Garments take the wearer's shape. Frames have a transparent background.
        """
        from stages.tryon import stage
        from stages.tryon.config import PRESETS

        console = Console(as_json)
        base = preset_config(PRESETS, preset)
        config = replace(
            base,
            betas=betas,
            camera=camera,
            frames=frames,
            fps=fps,
            width=width or base.width,
            height=height or base.height,
            background=background,
            passes=names(passes),
            swap=swap,
            push=push,
            restore=restore,
            penetration=penetration,
        )
        if dry_run:
            console.plan(stage.plan(bundles, poses, output, config))
            return
        result = stage.run(bundles, poses, output, config, console)
        worn = " ".join(str(bundle) for bundle in bundles)
        console.result(
            {"path": result.path, **result.summary},
            next_command=f"gw render {worn} --poses {poses} --camera orbit -o render",
        )

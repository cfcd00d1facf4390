"""`gw tryon`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Preset, preset_config


def register(app: typer.Typer) -> None:
    @app.command("tryon")
    @command
    def tryon(
        bundles: Annotated[
            list[Path], typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="One body and its garments.")
        ],
        poses: Annotated[Path, typer.Option(help="The motion: npz of SMPL-X or AMASS, or BVH.")],
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of film and frames.")] = Path(
            "tryon"
        ),
        betas: Annotated[str, typer.Option(help="Another body shape: up to ten numbers, 0.5,-1.2.")] = "",
        camera: Annotated[str, typer.Option(help="static | orbit.")] = "static",
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
            passes=tuple(name.strip() for name in passes.split(",") if name.strip()),
            swap=swap,
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

"""`gw bench playback`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json


def register(bench: typer.Typer) -> None:
    @bench.command("playback")
    @command
    def playback(
        bundles: Annotated[list[Path], typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="The outfit.")],
        poses: Annotated[Path, typer.Option(help="The motion.")],
        size: Annotated[int, typer.Option(min=16, max=8192, help="Pixels, width and height.")] = 512,
        frames: Annotated[int, typer.Option(min=1, help="Frames that are timed.")] = 60,
        camera: Annotated[str, typer.Option(help="static | orbit.")] = "static",
        threads: Annotated[int, typer.Option(min=0, help="Frames at a time; 0: one per core.")] = 0,
        cull: Annotated[
            bool, typer.Option(help="Leave out body Gaussians that nobody can see beneath garments.")
        ] = True,
        as_json: Json = False,
    ) -> None:
        """Measure how fast an outfit plays: from pose to pixels, with the penetration pass.

        The rate is that of frames side by side, one per core; the split is of one frame by itself. Bundles
        made with `gw export-garment --distilled` are the fast ones.
        """
        from stages.workflows import playback as stage
        from stages.workflows.playback import PlaybackConfig

        console = Console(as_json)
        config = PlaybackConfig(frames=frames, size=size, camera=camera, threads=threads, cull=cull)
        console.result(stage.run(bundles, poses, config, console).summary)

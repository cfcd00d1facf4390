"""`gw view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import artifacts
from gw_cli.console import Console, command
from gw_cli.inputs import check_poses, check_sources
from gw_cli.options import Betas, Distilled, DryRun, FrameRate, Json, Swap


def register(app: typer.Typer) -> None:
    @app.command("view")
    @command
    def view(
        sources: Annotated[
            list[Path] | None,
            typer.Argument(
                metavar="SUBJECT|BODY.gwg …",
                help="Bundles that are worn, or a trained subject.",
                autocompletion=artifacts,
            ),
        ] = None,
        wardrobe: Annotated[Path | None, typer.Option(help="A folder of bundles to swap in and out.")] = None,
        poses: Annotated[
            list[Path] | None,
            typer.Option(
                help="A motion to play (npz of SMPL-X or AMASS, or BVH); may be given several times."
            ),
        ] = None,
        betas: Betas = "",
        fps: FrameRate = 0.0,
        host: Annotated[
            str, typer.Option(help="Address to listen on; beyond this machine a token is asked for.")
        ] = "127.0.0.1",
        port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8770,
        open_browser: Annotated[
            bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
        ] = False,
        distilled: Distilled = False,
        drive: Annotated[
            str,
            typer.Option(
                help="What moves garments: auto | bones | learned | simulated; by layer: "
                "lower=bones,upper=learned."
            ),
        ] = "auto",
        swap: Swap = True,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Look at outfits in the browser: turn, swap, reshape, play.

        Layers go on and off, garments are swapped from a folder, ten sliders change the body's shape, a
        timeline plays the motion; the picture button saves what `gw render` would draw from there. Ends with
        Ctrl-C. Only this machine can reach the page; with --host 0.0.0.0 others can who know the printed
        address, which then holds a random token.

        Examples:

        gw view body.gwg skirt.gwg --poses walk.bvh

        gw view body.gwg --wardrobe wardrobe/ --poses walk.bvh --poses dance.npz

        gw view SUBJECT

        From another machine over ssh: ssh -L 8770:127.0.0.1:8770 HOST, then open http://127.0.0.1:8770/ here.
        """
        import webbrowser

        from stages.view.config import ViewConfig

        console = Console(as_json)
        config = ViewConfig(host, port, betas, fps, swap, distilled, drive)
        given, motions = list(sources or []), list(poses or [])
        check_sources(given)
        check_poses(motions)

        from stages.view import stage

        if dry_run:
            console.plan(stage.plan(given, wardrobe, motions, config))
            return

        def ready(url: str) -> None:
            console.say(f"open {url}   (Ctrl-C ends)")
            if open_browser:
                webbrowser.open(url)

        console.result(stage.run(given, wardrobe, motions, config, console, ready))

"""`gw view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import artifacts
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_poses, check_sources
from gw_cli.options import DryRun, Json
from stages.view.config import ViewConfig


def register(app: typer.Typer) -> None:
    @app.command("view")
    @command
    @config_options({"view": ViewConfig()})
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
                help="A motion to play (npz of SMPL-X or AMASS, or BVH), or `canonical`; may be given "
                "several times."
            ),
        ] = None,
        open_browser: Annotated[
            bool, typer.Option("--open/--no-open", help="Open the page in the browser.")
        ] = False,
        config: ViewConfig = ViewConfig(),
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Look at outfits in the browser: turn, swap, reshape, play.

        Layers go on and off, and garments are swapped from a folder. Ten sliders change the body's shape, and
        a timeline plays the motion. The screenshot button saves what `gw render` would draw from there.
        Ctrl-C ends the viewer. Only this machine can reach the page. With --host 0.0.0.0 other machines can
        reach it too, at the printed address, which then holds a random token.

        Examples:

        gw view body.gwg skirt.gwg --poses walk.bvh

        gw view body.gwg --wardrobe wardrobe/ --poses walk.bvh --poses dance.npz

        gw view SUBJECT

        From another machine over ssh: ssh -L 8770:127.0.0.1:8770 HOST, then open http://127.0.0.1:8770/ here.
        """
        import webbrowser

        console = Console(as_json)
        bundles, motions = list(sources or []), list(poses or [])
        check_sources(bundles)
        check_poses(motions)

        console.loading()
        from stages.view import stage

        if dry_run:
            console.plan(stage.plan(bundles, wardrobe, motions, config))
            return

        def ready(url: str) -> None:
            console.say(f"open {url}   (Ctrl-C ends)")
            if open_browser:
                webbrowser.open(url)

        console.result(stage.run(bundles, wardrobe, motions, config, console, ready))

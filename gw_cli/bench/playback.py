"""`gw bench playback`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_bundles, check_poses
from gw_cli.options import Json
from stages.workflows.config import PlaybackConfig


def register(bench: typer.Typer) -> None:
    @bench.command("playback")
    @command
    @config_options({"playback": PlaybackConfig()})
    def playback(
        bundles: Annotated[list[Path], typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="The outfit.")],
        poses: Annotated[Path, typer.Option(help="The motion, or `canonical`.")],
        config: PlaybackConfig = PlaybackConfig(),
        as_json: Json = False,
    ) -> None:
        """Measure how fast an outfit plays: from pose to pixels, with the penetration pass.

        The rate is that of frames in parallel, one per core. The times are those of one frame by itself.
        Bundles made with `gw export-garment --distilled` are the fast ones.
        """
        console = Console(as_json)
        check_bundles(bundles)
        check_poses([poses])
        console.loading()
        from stages.workflows import playback as stage

        console.result(stage.run(bundles, poses, config, console).summary)

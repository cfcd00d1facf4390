"""`gw render`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import artifacts
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_poses, check_sources
from gw_cli.options import DryRun, Json, without_shard
from stages.shared.errors import UsageProblem
from stages.shared.render_sequence.config import PRESETS, RenderConfig
from stages.shared.targets import check_file_target


def register(app: typer.Typer) -> None:
    @app.command("render")
    @command
    @config_options(PRESETS, "draft")
    def render(
        sources: Annotated[
            list[Path],
            typer.Argument(
                metavar="SUBJECT|BODY.gwg …", help="A trained subject, or bundles.", autocompletion=artifacts
            ),
        ],
        poses: Annotated[
            Path | None,
            typer.Option(
                help="The motion (npz of SMPL-X or AMASS, or BVH), or `canonical`: the pose of the maps; "
                "default: the subject's own, or the capture's."
            ),
        ] = None,
        cameras: Annotated[
            Path | None, typer.Option(help="A capture: its cameras, for the frames it has images of.")
        ] = None,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Folder of film and frames; default: render.")
        ] = None,
        html: Annotated[
            Path | None,
            typer.Option(
                help="Write one page that shows a frame, or plays several, from all sides; alone unless -o."
            ),
        ] = None,
        config: RenderConfig = PRESETS["draft"],
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Write film, frames and splat files of a subject, or of an outfit of bundles.

        Frames have a transparent background; the film plays in a browser. With --cameras the frames can be
        scored: gw evaluate --frames OUT --truth CAPTURE.

        Examples:

        gw render body.gwg skirt.gwg --poses walk.bvh --camera orbit -o walk

        gw render body.gwg skirt.gwg --poses walk.bvh --background transparent --video vp9

        gw render body.gwg skirt.gwg --poses walk.bvh --export ply,spz --no-pictures -o splats

        gw render body.gwg skirt.gwg --poses canonical --html skirt.html

        gw render body.gwg skirt.gwg --poses walk.bvh --frames 0:150 --html walk.html

        gw render SUBJECT --cameras CAPTURE --passes depth,layers -o views

        A JSON file as --camera holds keys between which the camera glides:
        {"format": "gw-camera-path", "version": 1, "keys": [{"frame": 0, "position": [0, 1, 3],
        "target": [0, 1, 0], "field_of_view": 35}, {"frame": 90, "position": [3, 1, 0], "target": [0, 1, 0]}]}
        or "cameras": one per frame, with matrices as in a capture's cameras.json.

        The same command continues a run that was killed. On many machines, use the same command with
        --shard 1/4 to --shard 4/4 and the same -o, and then once without --shard, which puts the parts
        together and renders what is missing.
        """
        console = Console(as_json)
        check_sources(sources)
        check_poses([poses])
        check_exists(cameras)
        if html is not None:
            check_file_target(html, "--html a.html")

        if html is not None and output is None and config.shard:
            raise UsageProblem(
                "A page cannot be written in parts.",
                "options --html, --shard",
                "Leave out --shard, or give -o too.",
            )
        console.loading()
        from stages.render import page, stage

        if html is not None and output is None:
            if dry_run:
                console.plan(page.plan(sources, poses, cameras, html, config))
                return
            console.result(page.run(sources, poses, cameras, html, config, console), watch=html)
            return
        target = output or Path("render")
        if dry_run:
            if html is not None:
                page.plan(sources, poses, cameras, html, config)
            console.plan(stage.plan(sources, poses, cameras, target, config))
            return
        result = stage.run(sources, poses, cameras, target, config, console)
        if html is not None and result.complete:
            page.run(sources, poses, cameras, html, config, console)
        shown = {"path": result.path, **result.summary}
        if not result.complete:
            console.result(shown, without_shard(sys.argv), when="when all parts are done")
            return
        following = ("gw", "evaluate", "--frames", result.path, "--truth", cameras) if cameras else None
        film = result.summary.get("video")
        console.result(shown, following, watch=html or (result.path / str(film) if film else None))

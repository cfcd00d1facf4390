"""`gw render`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import artifacts
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_poses, check_sources
from gw_cli.options import (
    AlphaMin,
    Background,
    Betas,
    Cull,
    Distilled,
    Drive,
    DryRun,
    FrameRate,
    Ground,
    Json,
    Passes,
    Penetration,
    Pixels,
    Preset,
    Push,
    Restore,
    Rows,
    Shard,
    Swap,
    TransmittanceMin,
    names,
    preset_config,
    without_shard,
)
from stages.shared.errors import UsageProblem
from stages.shared.splat.settings import ALPHA_MIN, TRANSMITTANCE_MIN
from stages.shared.targets import check_file_target


def register(app: typer.Typer) -> None:
    @app.command("render")
    @command
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
            typer.Option(help="Write one page that shows the first frame from all sides; alone unless -o."),
        ] = None,
        camera: Annotated[
            str,
            typer.Option(help="static | orbit | PATH.json; with --cameras the name of one camera."),
        ] = "",
        turns: Annotated[float, typer.Option(help="How often orbit walks around.")] = 1.0,
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
        video: Annotated[str, typer.Option(help="auto | h264 | vp9 | none.")] = "auto",
        export: Annotated[str, typer.Option(help="Also write every frame's Gaussians: ply,spz,glb.")] = "",
        up: Annotated[
            str, typer.Option(help="Axis that points up in exports: auto (-y in ply, else y) | y | -y.")
        ] = "auto",
        pictures: Annotated[bool, typer.Option(help="Write pictures and film, or exports only.")] = True,
        shard: Shard = "",
        swap: Swap = True,
        push: Push = False,
        restore: Restore = True,
        drive: Drive = "auto",
        penetration: Penetration = True,
        ground: Ground = True,
        cull: Cull = True,
        alpha_min: AlphaMin = ALPHA_MIN,
        transmittance_min: TransmittanceMin = TRANSMITTANCE_MIN,
        preset: Preset = "draft",
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

        gw render SUBJECT --cameras CAPTURE --passes depth,layers -o views

        A JSON file as --camera holds keys between which the camera glides:
        {"format": "gw-camera-path", "version": 1, "keys": [{"frame": 0, "position": [0, 1, 3],
        "target": [0, 1, 0], "field_of_view": 35}, {"frame": 90, "position": [3, 1, 0], "target": [0, 1, 0]}]}
        or "cameras": one per frame, with matrices as in a capture's cameras.json.

        A run that was killed goes on where it was: type the same command again. On many machines: the same
        command with --shard 1/4 to --shard 4/4 into the same -o, and then once without --shard, which puts
        the parts together (and renders what is missing).
        """
        from stages.shared.render_sequence.config import PRESETS

        console = Console(as_json)
        base = preset_config(PRESETS, preset)
        config = replace(
            base,
            betas=betas,
            frames=frames,
            fps=fps,
            camera=camera,
            turns=turns,
            take=take,
            width=width or base.width,
            height=height or base.height,
            background=background,
            distilled=distilled,
            layers=names(layers),
            passes=names(passes),
            video=video,
            exports=names(export),
            up=up,
            pictures=pictures,
            shard=shard,
            swap=swap,
            push=push,
            restore=restore,
            drive=drive,
            penetration=penetration,
            ground=ground,
            cull=cull,
            alpha_min=alpha_min,
            transmittance_min=transmittance_min,
        )
        check_sources(sources)
        check_poses([poses])
        check_exists(cameras)
        if html is not None:
            check_file_target(html, "--html a.html")

        from stages.render import page, stage

        if html is not None and output is None:
            if shard:
                raise UsageProblem(
                    "One page has no parts.", "options --html, --shard", "Leave out --shard, or give -o too."
                )
            if dry_run:
                console.plan(page.plan(sources, poses, cameras, html, config))
                return
            console.result(page.run(sources, poses, cameras, html, config, console), f"open {html}")
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
        following = f"gw evaluate --frames {result.path} --truth {cameras}" if cameras else None
        if not result.complete:
            following = f"{without_shard(sys.argv)}   (when all parts are done)"
        console.result({"path": result.path, **result.summary}, next_command=following)

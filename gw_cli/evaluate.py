"""`gw evaluate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import subjects, trainings
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_stages, export_command
from gw_cli.options import DryRun, Json, without_shard
from stages.evaluate.config import PRESETS, EvaluateConfig, EvaluateInputs, check_inputs


def register(app: typer.Typer) -> None:
    @app.command("evaluate")
    @command
    @config_options(PRESETS, "draft", completion={"training": trainings})
    def evaluate(
        subject: Annotated[
            Path | None,
            typer.Argument(
                metavar="SUBJECT", help="Workspace folder of the subject.", autocompletion=subjects
            ),
        ] = None,
        frames: Annotated[
            Path | None, typer.Option(help="Instead of a subject: output of gw render --cameras CAPTURE.")
        ] = None,
        truth: Annotated[
            Path | None,
            typer.Option(
                help="With --frames: the capture that shows the same. With --images: folder of pictures."
            ),
        ] = None,
        images: Annotated[
            Path | None,
            typer.Option(help="Instead of a subject: any folder of pictures, named as those of --truth."),
        ] = None,
        masks: Annotated[
            Path | None,
            typer.Option(
                help="With --images: folder of foreground masks; without, the alpha of --truth, if any."
            ),
        ] = None,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Folder; default: SUBJECT/evaluation.")
        ] = None,
        perceptual_weights: Annotated[
            Path | None,
            typer.Option(
                metavar="FILE", help="VGG-16 and LPIPS weights, safetensors; without, lpips is null."
            ),
        ] = None,
        true_meshes: Annotated[
            list[str] | None,
            typer.Option(
                metavar="FILE",
                help="Also measure garments against their true meshes: gt/meshes.npz of a take (TAKE=FILE "
                "where the path does not name it), or the folder of a capture that has them. Repeatable.",
            ),
        ] = None,
        config: EvaluateConfig = PRESETS["draft"],
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Score a trained subject on poses and views it has not seen, and a baseline without learning.

        The baseline is the template with projected colours, moved by the bones. Figures over the foreground
        come first. psnr and ssim over the whole picture are the ones that papers print. ms_ssim compares
        the pictures at five sizes. flip is a perceptual difference that needs no weights (0 is equal). With
        --frames and --truth, rendered frames are scored against a capture. With --images and --truth, any
        two folders of pictures are compared.

        A run that was stopped continues where it was. On several machines: run the same command with
        --shard 1/4 to --shard 4/4, and then once without --shard, which merges the parts.

        With --true-meshes (simulated captures have them), vertex_error says how far each garment is from the
        true one, in metres, and how far its texels are when the bones alone move them. It is measured
        between the surfaces, and between points of the cloth (material), which also shows sliding. Give
        the training take's file too.
        """
        console = Console(as_json)
        inputs = EvaluateInputs(subject, frames, images, truth, masks, tuple(true_meshes or ()))
        check_inputs(inputs)
        if subject is not None:
            check_stages(subject, "train")
        console.loading()
        from stages.evaluate import stage

        if dry_run:
            console.plan(stage.plan(inputs, output, config, perceptual_weights))
            return
        result = stage.run(inputs, output, config, console, perceptual_weights)
        shown = {"path": result.path, **result.summary}
        if not result.complete:
            console.result(shown, without_shard(sys.argv), when="when all parts are done")
            return
        console.result(shown, export_command(subject) if subject else None)

"""`gw evaluate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli.completion import subjects, trainings
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_exists, check_stages
from gw_cli.options import DryRun, Json, without_shard
from stages.evaluate.config import PRESETS, EvaluateConfig
from stages.shared.errors import UsageProblem


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
        """Score a trained subject on poses and views it has not seen, beside a baseline that learned nothing.

        The baseline is the template with projected colours, moved by the bones. Figures over the foreground
        come first; psnr and ssim over the whole picture are the ones that papers print. flip is a perceptual
        difference that needs no weights (0 is equal). With --frames and --truth, rendered frames are scored
        against a capture; with --images and --truth, any folders of pictures.

        A run that was killed goes on where it was. On many machines: the same command with --shard 1/4 to
        --shard 4/4, and then once without --shard, which puts the parts together.

        With --true-meshes (simulated captures have them), vertex_error says how far each garment is from the
        true one, in metres, beside its texels moved by the bones alone: between the surfaces, and material:
        from point to point of the cloth, which is what notices sliding. Give the training take's file too.
        """
        console = Console(as_json)
        given = sum(source is not None for source in (subject, frames, images))
        if true_meshes and subject is None:
            raise UsageProblem(
                "True meshes are compared with a trained subject.",
                "option --true-meshes",
                "Give the subject: gw evaluate SUBJECT --true-meshes FILE.",
            )
        if given != 1 or (truth is None) != (subject is not None) or (masks is not None and images is None):
            raise UsageProblem(
                "It is not clear what to evaluate.",
                "SUBJECT, --frames, --images, --truth, --masks",
                "Give a subject, or --frames DIR --truth CAPTURE, or --images DIR --truth DIR [--masks DIR].",
            )
        for source in (frames, images, truth, masks):
            check_exists(source, "folder")
        if images is not None and truth is not None:
            _images_against_truth(console, images, truth, masks, output, config, dry_run, perceptual_weights)
            return
        if frames is not None and truth is not None:
            _frames_against_truth(console, frames, truth, output, config, dry_run, perceptual_weights)
            return
        assert subject is not None
        check_stages(subject, "train")
        from stages.evaluate import stage

        if dry_run:
            console.plan(stage.plan(subject, output, config, true_meshes or (), perceptual_weights))
            return
        result = stage.run(subject, output, config, console, perceptual_weights, true_meshes or ())
        _show(console, result, f"gw export-garment {subject} --layer lower -o lower.gwg")


def _show(console: Console, result: Any, following: str | None = None) -> None:
    """The result, and the command to type next: after a part the one that puts the parts together."""
    if not result.complete:
        following = f"{without_shard(sys.argv)}   (when all parts are done)"
    console.result({"path": result.path, **result.summary}, next_command=following)


def _frames_against_truth(
    console: Console,
    frames: Path,
    truth: Path,
    output: Path | None,
    config: Any,
    dry_run: bool,
    weights: Path | None,
) -> None:
    from stages.evaluate import truth as truth_stage

    folder = output or frames.parent / (frames.name + "_evaluation")
    if dry_run:
        console.plan(truth_stage.plan(frames, truth, folder, config, weights))
        return
    _show(console, truth_stage.run(frames, truth, folder, config, console, weights))


def _images_against_truth(
    console: Console,
    images: Path,
    truth: Path,
    masks: Path | None,
    output: Path | None,
    config: Any,
    dry_run: bool,
    weights: Path | None,
) -> None:
    from stages.evaluate import images as images_stage

    folder = output or images.parent / (images.name + "_evaluation")
    if dry_run:
        console.plan(images_stage.plan(images, truth, folder, masks, config, weights))
        return
    _show(console, images_stage.run(images, truth, folder, masks, config, console, weights))

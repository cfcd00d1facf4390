"""`gw bench curves`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.inputs import check_stages
from gw_cli.options import DryRun, Json, Preset, Seed, Subject, names
from stages.shared.errors import UsageProblem


def register(bench: typer.Typer) -> None:
    @bench.command("curves")
    @command
    def curves(
        subject: Subject,
        methods: Annotated[
            str,
            typer.Option(help="Of gaussian-wardrobe, animatable-gaussians, layga; trained in this order."),
        ] = "gaussian-wardrobe,animatable-gaussians,layga",
        without: Annotated[
            str, typer.Option(metavar="PARTS", help="Also gaussian-wardrobe without each of these parts.")
        ] = "",
        minutes: Annotated[float, typer.Option(min=0.01, help="Training time of each.")] = 20.0,
        points: Annotated[int, typer.Option(min=1, help="Times at which scores are taken.")] = 8,
        split: Annotated[str, typer.Option(help="Of novel-pose, novel-view.")] = "novel-pose,novel-view",
        frame_step: Annotated[int, typer.Option(min=1, help="Novel views: every so many-th frame.")] = 5,
        test_frame_step: Annotated[int, typer.Option(min=1, help="Novel poses: every so many-th frame.")] = 2,
        cameras: Annotated[int, typer.Option(min=0, help="At most so many cameras of a frame; 0: all.")] = 2,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Folder; default: SUBJECT/curves.")
        ] = None,
        redraw: Annotated[
            bool, typer.Option(help="Train nothing: draw again what curves.jsonl and the trainings hold.")
        ] = False,
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Train methods with the same budget, one after the other, and draw scores against minutes.

        Scores are taken while it trains, on a few views and off the clock. The trainings stay in the subject,
        so gw bench paper finds them. Ctrl-C leaves a checkpoint: the same command goes on from there, and
        what is finished is not done again. Curves of other budgets stay in the figure. Writes curves.jsonl,
        curves.png (the methods), ablations.png (--without, beside the whole method with the same budget),
        and of both the finished trainings beside the truth: pictures.png, ablation_pictures.png. --redraw
        with the same views (--split, --frame-step, --test-frame-step, --cameras) draws them again.
        """
        from stages.evaluate.config import EvaluateConfig

        console = Console(as_json)
        check_stages(subject, "bake-maps")

        from stages.workflows import curves as workflow

        budget = f" ({preset}, {minutes:g} min" + (f", seed {seed})" if seed else ")")
        runs = [name + budget for name in names(methods)]
        runs += [f"without {part}" + budget for part in names(without)]
        configs = {} if redraw else {name: workflow.config_of(name) for name in runs}
        if None in configs.values():
            raise UsageProblem("That is no name.", "options --methods and --without", "See gw train --help.")
        views = EvaluateConfig(
            splits=names(split), frame_step=frame_step, test_frame_step=test_frame_step, cameras=cameras
        )
        folder = output or subject / "curves"
        if dry_run:
            from stages.shared.plan import Plan

            workflow.check(subject, folder, configs, views)
            written = workflow.FILES + (workflow.ABLATION_FILES if without else ())
            files = [str(folder / name) for name in written]
            config = {"runs": list(configs), "minutes": minutes, "points": points}
            console.plan(Plan([str(subject)], files, config, seconds=60.0 * minutes * len(configs)))
            return
        console.result(workflow.run(subject, folder, configs, views, points, console))

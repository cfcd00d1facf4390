"""`gw bench curves`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_stages
from gw_cli.options import DryRun, Json, Preset, Seed, Subject, names
from stages.evaluate.config import EvaluateConfig
from stages.shared.errors import UsageProblem

_VIEWS = EvaluateConfig(test_frame_step=2, cameras=2)


def register(bench: typer.Typer) -> None:
    @bench.command("curves")
    @command
    @config_options({"views": _VIEWS}, omit=("methods", "training", "drive", "shard"))
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
        points: Annotated[int, typer.Option(min=1, help="Number of times at which scores are taken.")] = 8,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Folder; default: SUBJECT/curves.")
        ] = None,
        redraw: Annotated[
            bool, typer.Option(help="Train nothing: draw again what curves.jsonl and the trainings hold.")
        ] = False,
        config: EvaluateConfig = _VIEWS,
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Train methods with the same budget, one after the other, and draw scores against minutes.

        Scores are taken on a few views while a method trains; their time does not count. The trainings stay
        in the subject, where gw bench paper finds them. Ctrl-C leaves a checkpoint, and the same command goes
        on from there. Finished trainings are used again. Curves of other budgets stay in the figure.

        Writes curves.jsonl, curves.png (the methods) and ablations.png (--without, and the whole method with
        the same budget). pictures.png and ablation_pictures.png compare the trainings with the truth.
        --redraw with the same views (--split, --frame-step, --test-frame-step, --cameras) draws them again.
        """
        console = Console(as_json)
        check_stages(subject, "bake-maps")
        console.loading()

        from stages.workflows import curves as workflow

        budget = f" ({preset}, {minutes:g} min" + (f", seed {seed})" if seed else ")")
        runs = [name + budget for name in names(methods)]
        runs += [f"without {part}" + budget for part in names(without)]
        configs = {} if redraw else {name: workflow.config_of(name) for name in runs}
        if None in configs.values():
            raise UsageProblem("That is no name.", "options --methods and --without", "See gw train --help.")
        folder = output or subject / "curves"
        if dry_run:
            from stages.shared.plan import Plan

            workflow.check(subject, folder, configs, config)
            written = workflow.FILES + (workflow.ABLATION_FILES if without else ())
            files = [str(folder / name) for name in written]
            shown = {"runs": list(configs), "minutes": minutes, "points": points}
            console.plan(Plan([str(subject)], files, shown, seconds=60.0 * minutes * len(configs)))
            return
        console.result(workflow.run(subject, folder, configs, config, points, console))

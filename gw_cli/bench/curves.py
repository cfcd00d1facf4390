"""`gw bench curves`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Preset, Seed, Subject, names, preset_config

_ENDLESS = 10_000_000  # steps: the clock ends every run


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
        preset: Preset = "draft",
        seed: Seed = 0,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Train methods with the same budget, one after the other, and draw scores against minutes.

        Scores are taken while it trains, on a few views and off the clock. The trainings stay in the subject,
        so gw bench paper finds them. Ctrl-C leaves a checkpoint: the same command goes on from there, and
        what is finished is not done again. Curves of other budgets stay in the figure. Writes curves.jsonl,
        curves.png, pictures.png.
        """
        from stages.evaluate.config import EvaluateConfig
        from stages.train.config import PRESETS

        console = Console(as_json)
        base = replace(
            preset_config(PRESETS, preset), seed=seed, minutes=minutes, steps=_ENDLESS, device="cpu"
        )
        budget = f" ({preset}, {minutes:g} min" + (f", seed {seed})" if seed else ")")
        runs = {name + budget: replace(base, method=name) for name in names(methods)}
        runs |= {f"without {part}" + budget: replace(base, without=(part,)) for part in names(without)}
        views = EvaluateConfig(
            splits=names(split), frame_step=frame_step, test_frame_step=test_frame_step, cameras=cameras
        )
        folder = output or subject / "curves"
        if dry_run:
            from stages.shared.plan import Plan

            files = [str(folder / name) for name in ("curves.jsonl", "curves.png", "pictures.png")]
            config = {"runs": list(runs), "minutes": minutes, "points": points}
            console.plan(Plan([str(subject)], files, config, seconds=60.0 * minutes * len(runs)))
            return
        console.result(_run(subject, folder, runs, views, points, console))


def _run(
    subject: Path, folder: Path, runs: dict[str, Any], config: Any, points: int, console: Console
) -> dict[str, Any]:
    """Train and score every run that is not done, then draw."""
    from stages.evaluate.curves import CurveFile, CurveViews, curve_figure, outfit_of, side_by_side
    from stages.evaluate.stage import check_config
    from stages.pipeline import BAKE_MAPS
    from stages.shared.artifacts import Workspace
    from stages.shared.artifacts.files import make_folders, write_whole
    from stages.shared.artifacts.pictures import encode_png
    from stages.shared.outfit.outfit import Outfit
    from stages.shared.splat.cpu import warm_up
    from stages.train import stage
    from stages.train.method import settled
    from stages.train.watch import Watch

    check_config(config)
    for run in runs.values():
        settled(run)
    views = CurveViews.of(subject, config)
    most = 3 + len(Workspace(subject).require(BAKE_MAPS).summary["layers"])
    warm_up(console, tuple(sorted({1, 4, 5, most})))  # compiling is nobody's training time
    make_folders(folder)
    scored = f"{config.splits} {config.frame_step} {config.test_frame_step} {config.cameras}"
    curves = CurveFile(folder / "curves.jsonl", scored)
    trained = {}
    for name, run in runs.items():
        console.step(f"{name}, {run.minutes:g} minutes")
        grid = tuple(run.minutes * (index + 1) / points for index in range(points))

        def look(outfit: Outfit, minute: float, steps: int, name: str = name) -> None:
            scores = views.scores(outfit)
            curves.add({"name": name, "minutes": round(minute, 4), "steps": steps, **scores})
            shown = {split: means["psnr_foreground"] for split, means in scores.items()}
            console.say(f"{name} after {minute:.3g} minutes: {shown}")

        result = stage.run(subject, run, console, watch=Watch(grid, look))
        trained[name] = outfit_of(subject, result.artifact)
        if not any(point["minutes"] == round(run.minutes, 4) for point in curves.of(name)):
            look(trained[name], run.minutes, int(result.artifact.summary["steps"]))
    first = next(iter(runs.values()))
    stage.run(subject, first, console)  # in use afterwards: the first one
    picture = curve_figure(curves, list(views.splits))
    write_whole(folder / "curves.png", encode_png(picture))
    write_whole(folder / "pictures.png", encode_png(side_by_side(views, trained)))
    last = {name: curves.of(name)[-1] for name in runs}
    return {"path": folder, "last": last, "points": {name: len(curves.of(name)) for name in runs}}

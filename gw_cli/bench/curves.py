"""`gw bench curves`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json, Preset, Seed, Subject, names, preset_config
from stages.shared.errors import MissingInput, UsageProblem

if TYPE_CHECKING:
    from stages.evaluate.curves import CurveFile, CurveViews

_ENDLESS = 10_000_000  # steps: the clock ends every run
_FILES = ("curves.jsonl", "curves.png", "pictures.png")
_ABLATION_FILES = ("ablations.png", "ablation_pictures.png")
_NAME = re.compile(r"(without )?([\w-]+) \(([\w-]+), ([^ ]+) min(?:, seed (\d+))?\)")


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
        from stages.train.config import PRESETS

        console = Console(as_json)
        budget = f" ({preset}, {minutes:g} min" + (f", seed {seed})" if seed else ")")
        runs = [name + budget for name in names(methods)]
        runs += [f"without {part}" + budget for part in names(without)]
        preset_config(PRESETS, preset)  # known at all
        configs = {} if redraw else {name: _config_of(name) for name in runs}
        if None in configs.values():
            raise UsageProblem("That is no name.", "options --methods and --without", "See gw train --help.")
        views = EvaluateConfig(
            splits=names(split), frame_step=frame_step, test_frame_step=test_frame_step, cameras=cameras
        )
        folder = output or subject / "curves"
        if dry_run:
            from stages.shared.plan import Plan

            _checked(subject, folder, configs, views)

            files = [str(folder / name) for name in (*_FILES, *(_ABLATION_FILES if without else ()))]
            config = {"runs": list(configs), "minutes": minutes, "points": points}
            console.plan(Plan([str(subject)], files, config, seconds=60.0 * minutes * len(configs)))
            return
        _run(subject, folder, configs, views, points, console)


def _config_of(name: str) -> Any:
    """The training that a curve's name stands for: "layga (draft, 20 min)", "without sg (draft, 10 min)"."""
    from stages.train.config import PRESETS

    found = _NAME.fullmatch(name)
    if found is None or found[3] not in PRESETS:
        return None
    part = {"without": (found[2],)} if found[1] else {"method": found[2]}
    budget: dict[str, Any] = {"minutes": float(found[4]), "seed": int(found[5] or 0), "steps": _ENDLESS}
    return replace(preset_config(PRESETS, found[3]), device="cpu", **budget, **part)


def _run(
    subject: Path, folder: Path, runs: dict[str, Any], config: Any, points: int, console: Console
) -> None:
    """Train and score every run that is not done, then draw."""
    from stages.evaluate.curves import CurveFile
    from stages.shared.artifacts.files import make_folders

    views = _checked(subject, folder, runs, config)
    make_folders(folder)
    scored = f"{config.splits} {config.frame_step} {config.test_frame_step} {config.cameras}"
    curves = CurveFile(folder / "curves.jsonl", scored)
    if runs:
        _train(subject, runs, views, curves, points, console)
    if not curves.points:
        raise MissingInput(
            "There are no points of these views.",
            str(curves.path),
            "Leave --redraw away to train, or name the views of the points: --cameras and the like.",
        )
    missing = _draw(subject, folder, views, curves, console)
    shown = list(runs) or curves.names
    last = {name: curves.of(name)[-1] for name in shown}
    counts = {name: len(curves.of(name)) for name in shown}
    console.result({"path": folder, "last": last, "points": counts, "without_picture": missing})


def _checked(subject: Path, folder: Path, runs: dict[str, Any], config: Any) -> CurveViews:
    """The views that are scored; refuses what can be known before anything is trained."""
    from stages.evaluate.curves import CurveViews
    from stages.evaluate.stage import check_config
    from stages.pipeline import BAKE_MAPS
    from stages.shared.artifacts import Workspace
    from stages.shared.targets import check_folder_target
    from stages.train.resolve import resolve_settings

    check_config(config)
    for run in runs.values():
        resolve_settings(run)
    check_folder_target(folder)
    Workspace(subject).require(BAKE_MAPS)
    return CurveViews.of(subject, config)


def _train(
    subject: Path, runs: dict[str, Any], views: CurveViews, curves: CurveFile, points: int, console: Console
) -> None:
    """Train what is not done, and add a point to its curve whenever it is looked at."""
    from stages.evaluate.curves import outfit_of
    from stages.pipeline import BAKE_MAPS
    from stages.shared.artifacts import Workspace
    from stages.shared.outfit.outfit import Outfit
    from stages.shared.splat.cpu import warm_up
    from stages.train import stage
    from stages.train.watch import Watch

    most = 3 + len(Workspace(subject).require(BAKE_MAPS).summary["layers"])
    warm_up(console, tuple(sorted({1, 4, 5, most})))  # compiling is nobody's training time
    for name, run in runs.items():
        console.step(f"{name}, {run.minutes:g} minutes")
        grid = tuple(run.minutes * (index + 1) / points for index in range(points))

        def look(outfit: Outfit, minute: float, steps: int, name: str = name) -> None:
            scores = views.scores(outfit)
            curves.add({"name": name, "minutes": round(minute, 4), "steps": steps, **scores})
            shown = {split: means["psnr_foreground"] for split, means in scores.items()}
            console.say(f"{name} after {minute:.3g} minutes: {shown}")

        result = stage.run(subject, run, console, watch=Watch(grid, look))
        if not any(point["minutes"] == round(run.minutes, 4) for point in curves.of(name)):
            look(outfit_of(subject, result.artifact), run.minutes, int(result.artifact.summary["steps"]))
    stage.run(subject, next(iter(runs.values())), console)  # in use afterwards: the first one


def _draw(subject: Path, folder: Path, views: CurveViews, curves: CurveFile, console: Console) -> list[str]:
    """Write figures and pictures of all curves; returns those whose training is not in the subject."""
    from stages.bench_paper.trainings import training_like
    from stages.evaluate.beside import side_by_side
    from stages.evaluate.curves import SHOWN, SHOWN_OF_ABLATIONS, curve_figure, outfit_of
    from stages.shared.artifacts import Workspace
    from stages.shared.artifacts.files import write_whole
    from stages.shared.artifacts.pictures import encode_png

    console.step("drawing")
    workspace, missing = Workspace(subject), []
    sheets = ((curves.methods, SHOWN, _FILES[1:]), (curves.ablations, SHOWN_OF_ABLATIONS, _ABLATION_FILES))
    for drawn, shown, (figure, pictures) in sheets:
        if not drawn:
            continue
        write_whole(folder / figure, encode_png(curve_figure(curves, list(views.splits), drawn, shown)))
        found = {name: training_like(workspace, _config_of(name)) for name in drawn}
        missing += [name for name, artifact in found.items() if artifact is None]
        outfits = {name: outfit_of(subject, artifact) for name, artifact in found.items() if artifact}
        if outfits:
            write_whole(folder / pictures, encode_png(side_by_side(views.splits, outfits)))
    return list(dict.fromkeys(missing))

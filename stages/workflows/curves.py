"""Learning curves: train methods with equal budgets, score them during training, and draw the scores.

Reads:
    a SUBJECT with maps, and its capture.
Writes, into the output folder:
    curves.jsonl: every point; curves.png, ablations.png: scores against minutes; pictures.png and
    ablation_pictures.png: the finished trainings and the truth. The trainings stay in the subject.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.evaluate.comparison_sheet import compare_outfits
from stages.evaluate.curves import (
    SHOWN,
    SHOWN_OF_ABLATIONS,
    CurveFile,
    CurveViews,
    curve_figure,
    outfit_of,
)
from stages.evaluate.subject import check_config
from stages.pipeline import BAKE_MAPS
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.files import make_folders, write_whole
from stages.shared.artifacts.pictures import encode_png
from stages.shared.charts import check_charts
from stages.shared.errors import MissingInput
from stages.shared.outfit.outfit import Outfit
from stages.shared.report import Report
from stages.shared.splat.cpu import warm_up
from stages.shared.targets import check_folder_target
from stages.train import stage as train
from stages.train.config import PRESETS
from stages.train.monitor import IntervalCallback
from stages.train.resolve import resolve_settings
from stages.workflows.paper.trainings import training_like

FILES = ("curves.jsonl", "curves.png", "pictures.png")
ABLATION_FILES = ("ablations.png", "ablation_pictures.png")
_ENDLESS = 10_000_000  # steps: the clock ends every run
_NAME = re.compile(r"(without )?([\w-]+) \(([\w-]+), ([^ ]+) min(?:, seed (\d+))?\)")


def config_of(name: str) -> Any:
    """The training that the name of a curve means: "layga (draft, 20 min)", "without sg (draft, 10 min)"."""

    match = _NAME.fullmatch(name)
    if match is None or match[3] not in PRESETS:
        return None
    part = {"without": (match[2],)} if match[1] else {"method": match[2]}
    budget: dict[str, Any] = {"minutes": float(match[4]), "seed": int(match[5] or 0), "steps": _ENDLESS}
    return replace(PRESETS[match[3]], device="cpu", **budget, **part)


def run(
    subject: Path, folder: Path, runs: dict[str, Any], config: Any, points: int, report: Report
) -> dict[str, Any]:
    """Train and score every unfinished run, then draw."""
    views = check(subject, folder, runs, config)
    make_folders(folder)
    scored = f"{config.splits} {config.frame_step} {config.test_frame_step} {config.cameras}"
    curves = CurveFile(folder / "curves.jsonl", scored)
    if runs:
        _train(subject, runs, views, curves, points, report)
    if not curves.points:
        raise MissingInput(
            "There are no points of these views.",
            str(curves.path),
            "Leave --redraw away to train, or name the views of the points: --cameras and the like.",
        )
    missing = _draw(subject, folder, views, curves, report)
    shown = list(runs) or curves.names
    last = {name: curves.of(name)[-1] for name in shown}
    counts = {name: len(curves.of(name)) for name in shown}
    return {"path": folder, "last": last, "points": counts, "without_picture": missing}


def check(subject: Path, folder: Path, runs: dict[str, Any], config: Any) -> CurveViews:
    """The views to score. Refuses wrong settings before anything is trained."""
    check_charts()
    check_config(config)
    for run in runs.values():
        resolve_settings(run)
    check_folder_target(folder)
    Workspace(subject).require(BAKE_MAPS)
    return CurveViews.of(subject, config)


def _train(
    subject: Path, runs: dict[str, Any], views: CurveViews, curves: CurveFile, points: int, report: Report
) -> None:
    """Train one unfinished run. Each scoring adds a point to its curve."""
    most = 3 + len(Workspace(subject).require(BAKE_MAPS).summary["layers"])
    warm_up(report, tuple(sorted({1, 4, 5, most})))  # compiling is not training time
    for name, run in runs.items():
        report.step(f"{name}, {run.minutes:g} minutes")
        grid = tuple(run.minutes * (index + 1) / points for index in range(points))

        def look(outfit: Outfit, minute: float, steps: int, name: str = name) -> None:
            scores = views.scores(outfit)
            curves.add({"name": name, "minutes": round(minute, 4), "steps": steps, **scores})
            shown = {split: means["psnr_foreground"] for split, means in scores.items()}
            report.say(f"{name} after {minute:.3g} minutes: {shown}")

        result = train.run(subject, run, report, watch=IntervalCallback(grid, look))
        if not any(point["minutes"] == round(run.minutes, 4) for point in curves.of(name)):
            look(outfit_of(subject, result.artifact), run.minutes, int(result.artifact.summary["steps"]))
    train.run(subject, next(iter(runs.values())), report)  # in use afterwards: the first one


def _draw(subject: Path, folder: Path, views: CurveViews, curves: CurveFile, report: Report) -> list[str]:
    """Write figures and pictures of all curves. Returns the curves whose training is not in the subject."""
    report.step("drawing")
    workspace, missing = Workspace(subject), []
    sheets = ((curves.methods, SHOWN, FILES[1:]), (curves.ablations, SHOWN_OF_ABLATIONS, ABLATION_FILES))
    for drawn, shown, (figure, pictures) in sheets:
        if not drawn:
            continue
        write_whole(folder / figure, encode_png(curve_figure(curves, list(views.splits), drawn, shown)))
        trained = {name: training_like(workspace, config_of(name)) for name in drawn}
        missing += [name for name, artifact in trained.items() if artifact is None]
        outfits = {name: outfit_of(subject, artifact) for name, artifact in trained.items() if artifact}
        if outfits:
            write_whole(folder / pictures, encode_png(compare_outfits(views.splits, outfits)))
    return list(dict.fromkeys(missing))

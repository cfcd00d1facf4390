"""Learning curves: scored while it trains, resumed, drawn; looking does not disturb the run."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.evaluate.comparison_sheet import comparison_sheet, shown_frames
from stages.evaluate.curves import CurveFile, curve_figure
from stages.pipeline import TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.outfit.outfit import Outfit
from stages.train import stage
from stages.train.monitor import IntervalCallback
from stages.workflows.paper.trainings import method_of, trainings
from tests.stages.train.scene import make_subject, tiny


def test_looking_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[float, int, int]] = []

    def look(outfit: Outfit, minute: float, steps: int) -> None:
        seen.append((minute, steps, outfit.gaussians))
        assert all(not layer.model.training for layer in outfit.layers)
        faded = [layer.model.fading for layer in outfit.layers if getattr(layer.model, "anchors", None)]
        assert faded and all(float(value) == 1 for value in faded), "as if training ended now"

    clock = iter(range(10_000))
    monkeypatch.setattr("stages.train.loop.time.monotonic", lambda: float(next(clock)))
    watched = stage.run(
        make_subject(tmp_path / "a"), tiny(steps=6), watch=IntervalCallback((0.02, 0.05, 9), look)
    )
    monkeypatch.undo()
    plain = stage.run(make_subject(tmp_path / "b"), tiny(steps=6))
    assert [minute for minute, _, _ in seen] == [0.02, 0.05]
    assert [steps for _, steps, _ in seen] == sorted(steps for _, steps, _ in seen)
    assert all(gaussians == watched.artifact.summary["gaussians"] for _, _, gaussians in seen)
    for name in ("body", "upper"):
        one, other = watched.artifact.arrays(name), plain.artifact.arrays(name)
        assert all(np.array_equal(one[key], other[key]) for key in other)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], dict[str, Any]]:
    """A subject with curves of two methods and an ablation, the command that made them, and its result."""
    subject = make_subject(tmp_path_factory.mktemp("curves"))
    words = ["bench", "curves", str(subject), "--preset", "tiny", "--minutes", "0.02", "--points", "2"]
    words += ["--methods", "gaussian-wardrobe,layga", "--without", "sg", "--split", "novel-view", "--json"]
    assert CliRunner().invoke(app, [*words, "--dry-run"]).exit_code == 0
    assert not (subject / "curves").exists()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, (done.stderr, done.stdout[-2000:])
    return subject, words, json.loads(done.stdout.splitlines()[-1])["result"]


def points_in(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "curves.jsonl").read_text().splitlines()]


def test_command_trains_scores_and_draws(drawn: tuple[Path, list[str], dict[str, Any]]) -> None:
    subject, words, result = drawn
    names = [f"{name} (tiny, 0.02 min)" for name in ("gaussian-wardrobe", "layga", "without sg")]
    assert list(result["last"]) == names
    points = points_in(subject / "curves")
    assert {point["name"] for point in points} == set(names)
    assert all(point["novel_view"]["psnr_foreground"] > 5 for point in points)
    assert all(point["minutes"] <= 0.02 and point["steps"] > 0 for point in points)
    assert result["last"][names[0]]["minutes"] == 0.02
    assert result["without_picture"] == []
    for name, columns in (("pictures", 3), ("ablation_pictures", 3)):  # truth and two each
        pictures = cv2.imread(str(subject / f"curves/{name}.png"))
        assert pictures is not None and pictures.shape[1] in (columns * 200, columns * 420)
    workspace = Workspace(subject)
    found = trainings(workspace)
    assert sorted(map(method_of, found)) == ["gaussian-wardrobe", "gaussian-wardrobe", "layga"]
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0 and len(trainings(workspace)) == 3, "finished runs are not done again"
    assert points_in(subject / "curves") == points
    for wrong in (["--methods", "magic"], ["--methods", "a (b"], ["--without", "sgx"], ["--preset", "none"]):
        assert CliRunner().invoke(app, [*words, *wrong]).exit_code == 2, wrong


def test_redrawing_trains_nothing(
    drawn: tuple[Path, list[str], dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From what lies there, also where the trainings are of an earlier version of the code."""
    subject, folder = tmp_path / "subject", tmp_path / "subject/curves"
    shutil.copytree(drawn[0].parent, tmp_path, dirs_exist_ok=True)
    redraw = ["bench", "curves", str(subject), "--split", "novel-view", "--redraw", "--json"]
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"curves.png", "pictures.png", "ablations.png", "ablation_pictures.png"} <= set(before)
    for name in before.keys() - {"curves.jsonl"}:
        (folder / name).unlink()
    monkeypatch.setattr(stage, "TRAIN", replace(TRAIN, code_version=TRAIN.code_version + 1))

    def never(*_: object, **__: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(stage, "run", never)
    again = CliRunner().invoke(app, redraw)
    assert again.exit_code == 0, again.output
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert CliRunner().invoke(app, [*redraw, "--cameras", "1"]).exit_code == 66, "points of other views"
    subprocess.run(["chmod", "-R", "u+w", str(subject / "train")], check=True)
    shutil.rmtree(subject / "train")
    (folder / "pictures.png").unlink()
    bare = CliRunner().invoke(app, redraw)
    assert bare.exit_code == 0 and not (folder / "pictures.png").exists()
    assert len(json.loads(bare.stdout.splitlines()[-1])["result"]["without_picture"]) == 3


def test_the_trainings_stand_in_the_tables_of_the_paper(
    drawn: tuple[Path, list[str], dict[str, Any]], tmp_path: Path
) -> None:
    words = ["bench", "paper", str(drawn[0]), "-o", str(tmp_path), "--split", "novel-view", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])["result"]
    tables = ("novel_view", "ablation")
    own = {name: [row for row in found[name] if not row["published"]] for name in tables}
    assert [row["method"] for row in own["novel_view"]] == ["gaussian-wardrobe", "layga"]
    assert [row["without"] for row in own["ablation"]] == [["sg"], []]
    assert all(0 < row["scores"]["miou"] <= 1 for row in own["ablation"])
    assert all(row["scores"]["psnr"] > 5 for row in own["novel_view"])
    assert all(row["budget"] == 0.02 for row in own["novel_view"] + own["ablation"])


def test_columns_and_rows_of_pictures() -> None:
    """Every column as wide as its widest picture, every picture whole, names and scores around them."""
    red, blue = np.zeros((50, 260, 3), np.uint8), np.zeros((80, 30, 3), np.uint8)
    red[..., 0], blue[..., 2] = 200, 200
    rows = [("first", [red, blue], ["", "20 dB"]), ("second", [blue, red], ["", "10 dB"])]
    sheet = comparison_sheet(["truth", "a name that is much longer than its column is wide"], rows)
    assert sheet.shape == (40 + 2 * 80 + 80 + 50 + 30, 2 * 270, 3)
    for color in (red[0, 0], blue[0, 0]):
        assert (sheet == color).all(axis=2).sum() == (50 * 260 if color[0] else 80 * 30) * 2
    ink = np.asarray(sheet.max(axis=2) < 120)
    assert ink[:40, :270].any() and ink[:40, 272:538].any() and not ink[:40, 538:].any()


@pytest.mark.parametrize("count, expected", [(1, [5]), (2, [3, 8]), (3, [2, 5, 9]), (20, list(range(1, 11)))])
def test_frames_that_are_shown(count: int, expected: list[int]) -> None:
    frames: list[Any] = [SimpleNamespace(first=index == 0, frame=index) for index in range(11)]
    found = [frame.frame for frame in shown_frames(frames, count)]
    assert len(found) == min(count, 10) and 0 not in found
    assert all(abs(one - other) <= 1 for one, other in zip(found, expected, strict=True)), found
    assert shown_frames(frames[:1], count) == frames[:1]


def test_points_of_other_views_are_not_mixed(tmp_path: Path) -> None:
    file = CurveFile(tmp_path / "c.jsonl", "few")
    for minutes, value in ((2.0, 20.0), (1.0, 18.0), (2.0, 21.0)):
        scores = {"psnr_foreground": value, "ssim_foreground": None}
        file.add({"name": "a", "minutes": minutes, "steps": 1, "novel_view": scores})
    again = CurveFile(tmp_path / "c.jsonl", "few")
    assert [(p["minutes"], p["novel_view"]["psnr_foreground"]) for p in again.of("a")] == [(1, 18), (2, 21)]
    assert CurveFile(tmp_path / "c.jsonl", "many").points == []
    assert curve_figure(again, ["novel_view", "novel_pose"], ["a"]).shape[1] == 1800


def test_which_curves_stand_together(tmp_path: Path) -> None:
    """Ablations beside the whole method of their budget, which is left out of the methods' figure."""
    file = CurveFile(tmp_path / "c.jsonl", "few")
    short, long, longest = (f" (draft, {minutes} min)" for minutes in (10, 20, 90))
    names = ["layga" + long, "gaussian-wardrobe" + long, "without sg" + short, "gaussian-wardrobe" + short]
    names += ["gaussian-wardrobe" + longest, "animatable-gaussians" + long]
    for name in names:
        file.add({"name": name, "minutes": 1.0, "steps": 1})
    assert file.names[0].startswith("gaussian-wardrobe")
    assert file.ablations == ["gaussian-wardrobe" + short, "without sg" + short]
    assert set(file.methods) == set(names) - set(file.ablations)
    file.add({"name": "without sg" + long, "minutes": 1.0, "steps": 1})
    assert "gaussian-wardrobe" + long in file.methods and "gaussian-wardrobe" + long in file.ablations
    alone = CurveFile(tmp_path / "d.jsonl", "few")
    for name in ("gaussian-wardrobe" + short, "without pe" + short):
        alone.add({"name": name, "minutes": 1.0, "steps": 1})
    assert alone.methods == ["gaussian-wardrobe" + short] and len(alone.ablations) == 2

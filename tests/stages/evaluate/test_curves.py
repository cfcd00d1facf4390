"""Learning curves: scored while it trains, resumed, drawn; looking does not disturb the run."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.bench_paper.trainings import method_of, trainings
from stages.evaluate.curves import CurveFile, curve_figure
from stages.evaluate.figure import COLORS, Curve, Panel, figure, ticks
from stages.shared.artifacts import Workspace
from stages.shared.outfit.outfit import Outfit
from stages.train import stage
from stages.train.watch import Watch
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
    watched = stage.run(make_subject(tmp_path / "a"), tiny(steps=6), watch=Watch((0.02, 0.05, 9), look))
    monkeypatch.undo()
    plain = stage.run(make_subject(tmp_path / "b"), tiny(steps=6))
    assert [minute for minute, _, _ in seen] == [0.02, 0.05]
    assert [steps for _, steps, _ in seen] == sorted(steps for _, steps, _ in seen)
    assert all(gaussians == watched.artifact.summary["gaussians"] for _, _, gaussians in seen)
    for name in ("body", "upper"):
        one, other = watched.artifact.arrays(name), plain.artifact.arrays(name)
        assert all(np.array_equal(one[key], other[key]) for key in other)


def test_command_trains_scores_and_draws(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    words = ["bench", "curves", str(subject), "--preset", "tiny", "--minutes", "0.02", "--points", "2"]
    words += ["--methods", "gaussian-wardrobe,layga", "--without", "sg", "--split", "novel-view", "--json"]
    assert CliRunner().invoke(app, [*words, "--dry-run"]).exit_code == 0
    assert not (subject / "curves").exists()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, (done.stderr, done.stdout[-2000:])
    result = json.loads(done.stdout.splitlines()[-1])["result"]
    names = [f"{name} (tiny, 0.02 min)" for name in ("gaussian-wardrobe", "layga", "without sg")]
    assert list(result["last"]) == names
    points = [json.loads(line) for line in (subject / "curves/curves.jsonl").read_text().splitlines()]
    assert {point["name"] for point in points} == set(names)
    assert all(point["novel_view"]["psnr_foreground"] > 5 for point in points)
    assert all(point["minutes"] <= 0.02 and point["steps"] > 0 for point in points)
    assert result["last"][names[0]]["minutes"] == 0.02
    pictures = cv2.imread(str(subject / "curves/pictures.png"))
    assert pictures is not None and pictures.shape[1] > 3 * 20
    workspace = Workspace(subject)
    found = trainings(workspace)
    assert sorted(map(method_of, found)) == ["gaussian-wardrobe", "gaussian-wardrobe", "layga"]
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0 and len(trainings(workspace)) == 3, "finished runs are not done again"
    assert [json.loads(line) for line in (subject / "curves/curves.jsonl").read_text().splitlines()] == points
    assert CliRunner().invoke(app, [*words, "--methods", "magic"]).exit_code == 2


def test_points_of_other_views_are_not_mixed(tmp_path: Path) -> None:
    file = CurveFile(tmp_path / "c.jsonl", "few")
    for minutes, value in ((2.0, 20.0), (1.0, 18.0), (2.0, 21.0)):
        scores = {"psnr_foreground": value, "ssim_foreground": None}
        file.add({"name": "a", "minutes": minutes, "steps": 1, "novel_view": scores})
    again = CurveFile(tmp_path / "c.jsonl", "few")
    assert [(p["minutes"], p["novel_view"]["psnr_foreground"]) for p in again.of("a")] == [(1, 18), (2, 21)]
    assert CurveFile(tmp_path / "c.jsonl", "many").points == []
    assert curve_figure(again, ["novel_view", "novel_pose"]).dtype == np.uint8


def _places(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Middles of the strokes of a colour by column, in the panel."""
    close = (np.abs(picture.astype(int) - color) < 25).all(axis=2)[:300]
    return np.array([(x, np.flatnonzero(close[:, x]).mean()) for x in np.flatnonzero(close.any(axis=0))])


def test_lines_rise_where_scores_rise() -> None:
    curves = [Curve("up", [(1, 10), (10, 20)]), Curve("down", [(1, 20), (10, 10)])]
    picture = figure([[Panel("title", "minutes", curves)]])
    up, down = _places(picture, COLORS[0]), _places(picture, COLORS[1])
    assert up[0, 1] > up[-1, 1] + 150 and down[0, 1] < down[-1, 1] - 150
    assert abs(up[0, 0] - down[0, 0]) < 6
    assert figure([[Panel("empty", "minutes", [Curve("a", [])])]]).shape[1] == picture.shape[1]


@pytest.mark.parametrize("low, high", [(0, 20), (0.7, 0.83), (13.1, 13.1), (0, 0), (-3, 1e6)])
def test_ticks_are_round_and_hold_the_range(low: float, high: float) -> None:
    found = ticks(low, high)
    assert found[0] <= low + 1e-9 * abs(low) and found[-1] >= high * (1 - 1e-9) and 2 <= len(found) <= 12
    steps = np.diff(found)
    assert np.allclose(steps, steps[0])
    leading = steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9)
    assert min(abs(leading - factor) for factor in (1, 2, 5, 10)) < 1e-6

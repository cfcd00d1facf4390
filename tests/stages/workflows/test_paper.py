"""The paper's tables: published values as printed, one's own trainings as evaluated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.pipeline import BAKE_MAPS, TRAIN
from stages.shared.artifacts import Workspace
from stages.train.config import DEFAULT_METHOD, PARTS
from stages.train.methods import METHODS
from stages.workflows.paper.tables import ABLATION, NOVEL_POSE, NOVEL_VIEW, OwnRow, markdown, tables
from tests.shared.outfit.wardrobe import make_subject


def test_published_rows_name_methods_and_parts_that_exist() -> None:
    for row in (*NOVEL_POSE, *NOVEL_VIEW, *ABLATION):
        assert row.method in METHODS and set(row.without) <= set(PARTS)
    best = {row.data: row for row in NOVEL_POSE if row.method == DEFAULT_METHOD}
    assert best["ActorsHQ"].scores == {"psnr": 28.38, "ssim": 0.9436, "lpips": 0.0397}
    for row in NOVEL_POSE:  # as the paper says: its method is the best of the three everywhere
        assert row.scores["psnr"] <= best[row.data].scores["psnr"]
    assert [row.scores["miou"] for row in ABLATION] == sorted(row.scores["miou"] for row in ABLATION)


def test_rows_stand_in_the_tables_they_belong_to() -> None:
    scores = {"psnr": 20.0, "ssim": 0.8, "lpips": None, "miou": 0.7, "recall": 0.8, "f1": 0.75}
    rows = [
        OwnRow("me", "k1", "gaussian-wardrobe", (), 20.0, 100, {"novel_pose": scores, "novel_view": scores}),
        OwnRow("me", "k2", "layga", (), 20.0, 90, {"novel_view": scores}),
        OwnRow("me", "k3", "gaussian-wardrobe", ("sg",), None, 80, {"novel_view": scores}),
    ]
    found = tables(rows)
    own = {name: [row["training"] for row in table if not row["published"]] for name, table in found.items()}
    assert own == {"novel_pose": ["k1", "k2"], "novel_view": ["k1", "k2"], "ablation": ["k3", "k1"]}
    assert found["novel_pose"][-1]["split"] is None and found["novel_pose"][-1]["scores"]["psnr"] is None
    assert found["ablation"][-2]["split"] == "novel_view"
    text = markdown(found)
    assert "| ActorsHQ | GW | – | published | – | 28.38 | 0.9436 | 0.0397 |" in text
    assert "| me | gaussian-wardrobe | – | k1 | 20.0 | 20.00 | 0.8000 | – |" in text
    assert "| me | gaussian-wardrobe | sg | k3 | – | 0.7000 | 0.8000 | 0.7500 |" in text


def test_rows_that_compare_stand_together() -> None:
    """By subject and budget; the whole method stands beside ablations of its own budget only."""
    ours, less = "gaussian-wardrobe", (("sg",), ("pe",))
    rows = [OwnRow("me", f"g{b}", ours, (), b, 1, {}, float(b)) for b in (90, 10, 20)]
    rows += [OwnRow("me", f"a{b}", "layga", (), b, 1, {}, float(b)) for b in (20,)]
    rows += [OwnRow("me", f"w{parts[0]}", ours, parts, 10, 1, {}, 10.0) for parts in less]
    rows += [OwnRow("you", "y", ours, (), 10, 1, {}, 10.0)]
    found = tables(rows)
    own = {name: [row["training"] for row in table if not row["published"]] for name, table in found.items()}
    assert own["novel_pose"] == own["novel_view"] == ["g10", "g20", "a20", "g90", "y"]
    assert own["ablation"] == ["wpe", "wsg", "g10"]
    whole = [row["training"] for row in tables(rows[:4])["ablation"] if not row["published"]]
    assert whole == ["g10", "g20", "g90"], "without any ablation all of them are shown"


def test_command_evaluates_every_training_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = make_subject(tmp_path)
    workspace = Workspace(subject)
    first = workspace.require(TRAIN)
    with workspace.build(TRAIN, {"steps": 1}, {"bake-maps": workspace.require(BAKE_MAPS)}) as build:
        for name in ("body", "lower", "upper"):
            build.write_arrays(name, first.arrays(name))
        build.write_json("model.json", first.json("model.json"))
        build.summary(method="gaussian-wardrobe", without=["pe"], steps=1)
        build.measured(training_seconds=90.0)
    out = tmp_path / "bench"
    words = ["bench", "paper", str(subject), "-o", str(out), "--frame-step", "4", "--cameras", "1", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])["result"]
    ablation = [row for row in result["ablation"] if not row["published"]]
    assert [row["without"] for row in ablation] == [["pe"], []] and ablation[0]["minutes"] == 1.5
    assert all(row["scores"]["miou"] > 0.99 for row in ablation)
    assert [row["training"] for row in result["novel_view"] if not row["published"]] == [first.key]
    assert (out / "paper.md").read_text().startswith("Published")
    from stages.evaluate import stage

    def never(*_: object) -> None:
        raise AssertionError("evaluated twice")

    monkeypatch.setattr(stage, "run", never)
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0 and again.stdout.splitlines()[-1] == done.stdout.splitlines()[-1]
    assert CliRunner().invoke(app, [*words, "--cameras", "2"]).exit_code != 0


def test_a_subject_without_training_is_refused(tmp_path: Path) -> None:
    subject = make_subject(tmp_path, trained=False)
    assert (
        CliRunner().invoke(app, ["bench", "paper", str(subject), "-o", str(tmp_path / "x")]).exit_code == 66
    )

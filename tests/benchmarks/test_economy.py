"""`python -m tests.benchmarks.economy`: each row leaves out what it says, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.testing import CliRunner

from stages.shared.errors import MissingInput, UsageProblem
from stages.train import stage
from stages.workflows.command import Outcome
from tests.benchmarks.economy import run as economy
from tests.benchmarks.economy.__main__ import app
from tests.benchmarks.economy.run import ENDS, ROWS, STEP_ROWS, EconomyConfig, measure_row, whole_grid
from tests.benchmarks.economy.table import compared, markdown, summed_up
from tests.stages.train.scene import make_subject, tiny

CONFIG, TRAIN = EconomyConfig(steps=1, frames=2), tiny(steps=4)


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_subject(tmp_path_factory.mktemp("economy"))


@pytest.fixture(scope="module")
def rows(subject: Path) -> dict[str, dict[str, Any]]:
    with pytest.raises(MissingInput):
        measure_row(subject, "frame", TRAIN, CONFIG)
    stage.run(subject, TRAIN)
    before = sorted(subject.rglob("*"))
    found = {name: measure_row(subject, name, TRAIN, CONFIG) for name in ROWS}
    assert sorted(subject.rglob("*")) == before, "measuring writes nothing"
    return found


@pytest.mark.long
def test_rows_leave_out_what_they_say(rows: dict[str, dict[str, Any]]) -> None:
    all_of_them = rows["step"]
    assert all(row["seconds"] > 0 for row in rows.values())
    assert rows["step-whole-grid"]["parameters"] > all_of_them["parameters"]
    assert rows["step-whole-images"]["pixels"] > all_of_them["pixels"]
    for name in ("step-pass-per-camera", "step-separate-pictures"):
        same = {
            key: value for key, value in rows[name].items() if key in ("parameters", "pixels", "gaussians")
        }
        assert same == {key: all_of_them[key] for key in same}
    assert rows["step-nothing-saved"]["pixels"] == rows["step-whole-images"]["pixels"]
    assert rows["step-same-networks"]["parameters"] <= rows["step-nothing-saved"]["parameters"]
    for name, row in rows.items():
        exact = name.startswith("step") or name in ("frame-whole-layers", "frame-one-at-a-time")
        base = rows[name.split("-")[0]].get("psnr")
        assert (base is None and name.startswith("still")) or row["psnr"] == pytest.approx(
            base, abs=1e-3 if exact else 0.05
        ), name
    assert rows["frame-no-cull"]["gaussians"] == all_of_them["gaussians"]


def test_a_pass_per_camera_gives_the_same_gradients(subject: Path) -> None:
    gradients = []
    for one_pass in (True, False):
        trainer = stage.prepare(subject, TRAIN)
        trainer.one_pass = one_pass
        trainer._update = lambda *rest: None  # type: ignore[method-assign]
        trainer.step(3, 0.0)
        gradients.append([p.grad.clone() for p in trainer.parameters.values() if p.grad is not None])
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other, atol=1e-5 * max(1.0, float(one.abs().max())))


def test_a_larger_window_holds_the_same_texels(subject: Path) -> None:
    small, large = stage.prepare(subject, TRAIN), stage.prepare(subject, TRAIN, whole_grid)
    frame = small.frames[1]
    with torch.no_grad():
        for name in small.models:
            one, other = small.posed(frame)[name], large.posed(frame)[name]
            assert torch.allclose(one.means, other.means, atol=1e-6), "no network has learned anything yet"


@pytest.mark.long
def test_command_measures_every_row_in_its_process(
    rows: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def pretended(*words: str | Path, folder: Path | None = None) -> Outcome:
        asked.append(str(words[words.index("--row") + 1]))
        return Outcome(1.0, 10**8, rows[asked[-1]])

    monkeypatch.setattr(economy, "run_module", pretended)
    out = tmp_path / "economy"
    done = CliRunner().invoke(app, ["SUBJECT", "-o", str(out), "--json"])
    assert done.exit_code == 0, done.output
    assert asked[:12] == [*ENDS] * 3 and sorted(asked[12:]) == sorted(set(ROWS) - set(ENDS))
    stored = json.loads((out / "economy.json").read_bytes())
    assert [row["row"] for row in stored["rows"]] == list(ROWS) and stored["rows"][0]["slower"] == 1.0
    assert [len(row["seconds_of_rounds"]) for row in stored["rows"] if row["row"] in ENDS] == [3] * 4
    assert [entry["off_is"] for entry in stored["summary"]] == [
        "step-nothing-saved", "step-same-networks", "frame-nothing-saved",
    ]  # fmt: skip
    table = (out / "economy.md").read_text()
    assert all(f"{text} |" in table for text in ROWS.values())
    assert table.count("\n") == len(ROWS) + 2 + 1 + 3 + 2


def test_one_row_by_itself_and_what_is_refused(subject: Path) -> None:
    words = [str(subject), "--preset", "tiny", "--steps", "1", "--json"]
    done = CliRunner().invoke(app, [*words, "--row", "step"])
    assert json.loads(done.stdout.splitlines()[-1])["result"]["without"] == STEP_ROWS["step"]
    assert CliRunner().invoke(app, [*words, "--row", "leap"]).exit_code == 2
    with pytest.raises(UsageProblem):
        economy.run(subject, subject, "tiny", EconomyConfig(steps=0))


@pytest.mark.long
def test_minutes_leave_rows_out_but_never_the_summary(
    rows: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(*words: str | Path, folder: Path | None = None) -> Outcome:
        return Outcome(40.0, 10**8, rows[str(words[words.index("--row") + 1])])

    monkeypatch.setattr(economy, "run_module", slow)
    found = economy.run(tmp_path, tmp_path / "out", "tiny", EconomyConfig(rounds=2, minutes=0.5))
    assert [row["row"] for row in found["rows"]] == [name for name in ROWS if name in ENDS]
    assert set(found["left_out"]) == set(ROWS) - set(ENDS) and len(found["summary"]) == 2
    assert "Not measured" in (tmp_path / "out" / "economy.md").read_text()


def test_differences_are_against_the_first_of_the_part() -> None:
    rows = [
        {"row": "step", "without": "a", "seconds": 2.0, "peak_bytes": 1},
        {"row": "step-nothing-saved", "without": "b", "seconds": 6.0, "peak_bytes": 1},
        {"row": "frame", "without": "c", "seconds": 0.1, "peak_bytes": 1, "psnr": 20.0},
        {"row": "frame-nothing-saved", "without": "d", "seconds": 0.2, "peak_bytes": 1, "psnr": 20.25},
    ]
    told = compared(rows)
    assert [row["slower"] for row in told] == [1.0, 3.0, 1.0, 2.0]
    assert told[3]["psnr_difference"] == -0.25
    step, frame = summed_up(told)
    assert step["times_faster"] == 3.0 and step["goal_met"]
    assert frame["times_faster"] == 2.0 and frame["costs_decibels"] == 0.25 and not frame["goal_met"]
    table = markdown({"summary": [step, frame], "rows": told, "left_out": []}, ROWS)
    assert "20.250 | 0.250" in table and "| 20.000 / 20.250 |" in table

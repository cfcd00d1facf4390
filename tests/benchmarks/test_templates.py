"""The templates benchmark: rows with values, and None with a reason where there is no truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gw_cli.child import CommandFailed, run_command
from stages.bake_maps import stage as bake_maps
from stages.bake_maps.config import PRESETS as BAKE
from stages.canonicalize import stage as canonicalize
from stages.canonicalize.config import PRESETS as CANONICALIZE
from stages.register_template import stage as register_template
from stages.register_template.config import PRESETS as REGISTER
from stages.segment_layers import stage as segment_layers
from stages.segment_layers.config import PRESETS as SEGMENT
from stages.shared.body.load import embedded_body
from stages.workflows.command import Outcome
from tests.benchmarks.templates import stage
from tests.benchmarks.templates.config import BARS, Bar, BenchTemplatesConfig
from tests.benchmarks.templates.skinned import SkinnedLayer
from tests.benchmarks.templates.truth import fit_errors, label_scores
from tests.stages.dressed_body import LOWER, SKIN, UPPER, dressed, write_capture


def _in_this_process(command: str, *arguments: str | Path) -> Outcome:
    """What `run_command` does, without the seconds that a new process takes to start."""
    if command == "register-template":
        register_template.run(Path(arguments[0]), Path(arguments[2]), REGISTER["tiny"])
    else:
        module, presets = {
            "canonicalize": (canonicalize, CANONICALIZE),
            "segment-layers": (segment_layers, SEGMENT),
            "bake-maps": (bake_maps, BAKE),
        }[command]
        module.run(Path(arguments[0]), presets["tiny"])
    return Outcome(1.0, 1, {})


@pytest.fixture(scope="module")
def benched(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("bench")
    capture = write_capture(folder / "capture", dressed(), cameras=4, size=160, test=True)
    patch = pytest.MonkeyPatch()
    patch.setattr(stage, "run_command", _in_this_process)
    try:
        result = stage.run(capture, folder / "out", BenchTemplatesConfig("tiny", fit=False))
    finally:
        patch.undo()
    return result.path, result.summary


def test_every_item_has_rows_and_what_was_not_measured_says_why(benched: tuple[Path, dict]) -> None:
    path, summary = benched
    rows = {row["name"]: row for row in summary["rows"]}
    assert {row["item"] for row in summary["rows"]} == {1, 2, 3, 4, 5, 6}
    for row in summary["rows"]:
        assert (row["value"] is None or row["bar"] is None) == (row["met"] is None)
        assert row["value"] is not None or row["note"]
    assert rows["fit_scan_joint_error_mm"]["note"] == "left out"
    assert rows["label_accuracy"]["value"] > 0.95
    assert rows["pose_back_max_m"]["met"] and rows["shape_transfer_max_m"]["met"]
    for layer in ("body", "lower", "upper"):
        assert 0 <= rows[f"unseen_area.{layer}"]["value"] < 0.01
    assert json.loads((path / "bench_templates.json").read_text())["rows"] == summary["rows"]
    assert (path / "table.md").read_text().count("\n") == len(summary["rows"]) + 2


def test_the_template_in_its_own_pose_fills_its_own_silhouette_unstretched(
    benched: tuple[Path, dict],
) -> None:
    rows = {row["name"]: row for row in benched[1]["rows"]}
    assert rows["skinned_iou"]["value"] > 0.99
    assert rows["stretch.lower"]["value"] == pytest.approx(1.0, abs=1e-3)
    assert rows["other_stretch.upper"]["value"] == pytest.approx(1.0, abs=1e-3)
    assert rows["other_stretch.upper"]["bar"] is None
    assert list(benched[1]["frames"]) == ["again 0"]


def test_times_and_memory_are_those_of_the_run_records(benched: tuple[Path, dict]) -> None:
    rows = {row["name"]: row["value"] for row in benched[1]["rows"]}
    for name in ("register-template", "canonicalize", "segment-layers", "bake-maps"):
        assert rows[f"stage_seconds.{name}"] > 0
        assert rows[f"stage_peak_bytes.{name}"] > 50e6


def test_stretch_is_the_largest_growth_of_an_edge() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    edges = np.array([[0, 1], [0, 2], [1, 2]])
    lengths = np.array([1.0, 1.0, np.sqrt(2)])
    layer = SkinnedLayer(
        vertices, np.array([[0, 1, 2]]), np.zeros((3, 55)), np.zeros((3, 10, 3)), edges, lengths
    )
    assert layer.stretch(vertices * [1, 2.5, 1]) == pytest.approx(2.5)
    assert replace(layer, edges=edges[:0], lengths=lengths[:0]).stretch(vertices) == 1.0


def test_label_scores_against_known_mistakes() -> None:
    truth = np.array([SKIN] * 50 + [UPPER] * 30 + [LOWER] * 20 + [255] * 10, np.uint8)
    found = truth.copy()
    assert label_scores(found, truth) == {"accuracy": 1.0, "miou": 1.0}
    found[50:60] = LOWER
    scores = label_scores(found, truth)
    assert scores["accuracy"] == pytest.approx(0.9)
    assert scores["miou"] == pytest.approx((1 + 20 / 30 + 20 / 30) / 3)
    assert label_scores(found, np.full_like(truth, 255)) == {"accuracy": None, "miou": None}


@pytest.mark.parametrize("seed", [0, 1])
def test_fit_errors_of_a_known_offset(seed: int) -> None:
    given = dressed(seed).poses
    moved = replace(given, translation=given.translation + np.array([0.0, 0.03, 0.04], np.float32))
    joint, shape = fit_errors(embedded_body(), moved, given, 0)
    assert joint == pytest.approx(0.05, abs=1e-5) and shape == pytest.approx(0.0, abs=1e-7)
    other = replace(given, betas=given.betas + np.eye(10, dtype=np.float32)[0])
    assert fit_errors(embedded_body(), other, given, 0)[1] > 0.002


def test_bars_are_sides_and_nothing_measured_is_neither_met_nor_missed() -> None:
    assert Bar("max", 3.0).met(2.9) and not Bar("max", 3.0).met(3.1)
    assert Bar("min", 0.9).met(0.9) and not Bar("min", 0.9).met(0.89)
    assert Bar("min", 0.9).met(None) is None
    assert (BARS["skinned_iou"].value, BARS["stretch"].value, BARS["label_miou"].value) == (0.93, 3.0, 0.93)


def test_a_command_that_fails_passes_its_message_on(tmp_path: Path) -> None:
    with pytest.raises(CommandFailed, match="canonicalize") as failure:
        run_command("canonicalize", tmp_path / "nobody")
    assert failure.value.what.startswith("The command `gw canonicalize") and failure.value.exit_code == 66
    assert failure.value.where.endswith("nobody")
    assert failure.value.fix.startswith("Run: gw register-template CAPTURE")


def test_a_command_that_dies_without_a_message_is_named() -> None:
    died = CommandFailed("gw train s", 139, "libnothing: Segmentation fault\n")
    assert "ended with 139" in died.what and "Segmentation" in died.where and died.exit_code == 139

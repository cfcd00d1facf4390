"""Evaluation of a subject whose truth differs from its render by a known number of grey levels."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.evaluate import stage
from stages.evaluate.config import EvaluateConfig, EvaluateInputs
from stages.evaluate.methods import Baseline
from stages.evaluate.subject import check_config
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.render import stage as render
from stages.shared.artifacts import Workspace
from stages.shared.body import BodyModel
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.render_sequence.config import RenderConfig
from tests.shared.outfit.wardrobe import SHIFT, cameras, make_subject, motion, worn

EXPECTED_PSNR = 20 * math.log10(255 / SHIFT)
CONFIG = EvaluateConfig(frame_step=2, pictures=1)


def test_both_splits_and_both_methods(dressed_subject: Path, tmp_path: Path) -> None:
    result = stage.run(EvaluateInputs(dressed_subject), tmp_path / "out", CONFIG)
    pose, view = result.summary["novel_pose"], result.summary["novel_view"]
    assert pose["trained"]["views"] == 10 and pose["trained_without_first"]["views"] == 8
    assert view["trained"]["views"] == 3 and view["baseline"]["views"] == 3
    for split in (pose, view):
        trained, baseline = split["trained"], split["baseline"]
        assert trained["psnr_foreground"] == pytest.approx(EXPECTED_PSNR, abs=1e-3)
        assert trained["iou"] == 1 and trained["miou"] > 0.99
        assert trained["sharpness"] == pytest.approx(1, abs=0.2)
        assert baseline["psnr_foreground"] < trained["psnr_foreground"]
        assert 0.6 < baseline["iou"] < 1 and baseline["miou"] > 0.5  # splats are fatter than the mesh
        assert trained["lpips"] is None and 0 < trained["flip"] < baseline["flip"]
    stored = json.loads((tmp_path / "out/evaluation.json").read_text())
    assert stored["novel_pose"]["trained"] == pose["trained"]
    rows = json.loads((tmp_path / "out/views.json").read_text())["novel_view"]
    assert {row["camera"] for row in rows} == {"cam2"} and {row["frame"] for row in rows} == {0, 2, 4}
    pictures = sorted(path.name for path in (tmp_path / "out").glob("*.png"))
    assert pictures == ["novel_pose_0.png", "novel_view_0.png"]


def test_baseline_alone_needs_no_training(tmp_path: Path) -> None:
    subject = make_subject(tmp_path, trained=False)
    config = EvaluateConfig(splits=("novel-view",), methods=("baseline",), frame_step=4, pictures=0)
    result = stage.run(EvaluateInputs(subject), None, config)
    assert result.path == subject / "evaluation" and set(result.summary["novel_view"]) == {
        "baseline",
        "baseline_without_first",
    }
    with pytest.raises(MissingInput, match="gw train"):
        stage.run(EvaluateInputs(subject), tmp_path / "x", CONFIG)


def test_baseline_is_the_mesh_moved_by_the_bones(dressed_subject: Path) -> None:
    """In the rest pose the tubes stand where they were baked, so a ray through a vertex meets it."""
    workspace = Workspace(dressed_subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    body = BodyModel.from_arrays(registered.arrays("body"))
    baseline = Baseline.load(workspace.require(SEGMENT_LAYERS), body, np.zeros(10, np.float32))
    still = motion(1)
    still.rotations[:] = 0
    scene = baseline.posed(still, 0)
    expected = np.concatenate([worn(name).maps.positions.numpy() for name in ("body", "lower", "upper")])
    assert np.abs(scene.vertices - expected).max() < 1e-5
    picture, alpha, labels = baseline.render(scene, cameras()[0], 2)
    pixels, _ = cameras()[0].project(np.array([[0.0, 0.1, 0.075]]))
    column, row = pixels[0].astype(int)
    assert labels[row, column] == 3 and alpha[row, column] == 1
    assert picture[row, column].argmax() == 2 and not picture[alpha == 0].any()


def test_frames_against_a_capture(dressed_subject: Path, tmp_path: Path) -> None:
    capture = dressed_subject.parent / "capture"
    config = RenderConfig(take="other", frames="0:3", penetration=False)
    render.run([dressed_subject], None, capture, tmp_path / "frames", config)
    result = stage.run(EvaluateInputs(frames=tmp_path / "frames", truth=capture), tmp_path / "out", CONFIG)
    scores = result.summary["tryon_truth"]
    assert scores["views"] == 9 and scores["psnr_foreground"] == pytest.approx(EXPECTED_PSNR, abs=0.3)
    assert scores["iou"] == 1 and scores["miou"] > 0.99 and scores["psnr_lower"] is not None
    assert result.summary["tryon_truth_without_first"]["views"] == 6
    assert (tmp_path / "out/tryon_truth_0.png").is_file()


def test_command_and_what_it_refuses(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    capture = dressed_subject.parent / "capture"
    words = [
        "evaluate",
        str(dressed_subject),
        "-o",
        out,
        "--split",
        "novel-view",
        "--frame-step",
        "4",
        "--json",
    ]
    assert CliRunner().invoke(app, [*words, "--dry-run"]).exit_code == 0
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    last = json.loads(done.stdout.splitlines()[-1])["result"]
    assert last["novel_view"]["trained"]["psnr_foreground"] == pytest.approx(EXPECTED_PSNR, abs=1e-3)
    for wrong, code in (
        (["evaluate"], 2),
        (["evaluate", str(dressed_subject), "--frames", out], 2),
        (["evaluate", str(dressed_subject), "--truth", out], 2),
        (["evaluate", "--images", out], 2),
        (["evaluate", str(dressed_subject), "--training", "ffff", "-o", out], 66),
        (["evaluate", str(dressed_subject), "--split", "novel-smell", "-o", out], 2),
        (["evaluate", str(dressed_subject), "--methods", "", "-o", out], 2),
        (["evaluate", "--frames", str(wardrobe), "--truth", str(capture), "-o", out], 66),
        (["evaluate", "--frames", str(tmp_path / "none"), "--truth", str(capture), "-o", out], 66),
    ):
        assert CliRunner().invoke(app, wrong).exit_code == code, wrong


def test_frames_of_another_size_are_refused(dressed_subject: Path, tmp_path: Path) -> None:
    capture = dressed_subject.parent / "capture"
    frames = tmp_path / "frames"
    render.run([dressed_subject], None, capture, frames, RenderConfig(take="other", frames="0:1"))
    path = frames / "frames/cam0/000000.png"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-1])
    from stages.shared.errors import BadData

    with pytest.raises(BadData, match="pixels, the truth"):
        stage.run(EvaluateInputs(frames=frames, truth=capture), tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()


def test_both_at_once_and_fewer_cameras(dressed_subject: Path, tmp_path: Path) -> None:
    config = EvaluateConfig(splits=("novel-both", "novel-pose"), methods=("trained",), cameras=1, pictures=0)
    result = stage.run(EvaluateInputs(dressed_subject), tmp_path / "out", config)
    assert result.summary["novel_both"]["trained"]["views"] == 5
    rows = json.loads((tmp_path / "out/views.json").read_text())
    assert {(row["take"], row["camera"]) for row in rows["novel_both"]} == {("other", "cam2")}
    assert {(row["take"], row["camera"]) for row in rows["novel_pose"]} == {("other", "cam0")}


def test_another_training_can_be_scored(tmp_path: Path) -> None:
    subject = make_subject(tmp_path)
    workspace = Workspace(subject)
    first = workspace.require(TRAIN)
    with workspace.build(TRAIN, {"steps": 1}, {"bake-maps": workspace.require(BAKE_MAPS)}) as build:
        for name in ("body", "lower", "upper"):
            arrays = first.arrays(name)
            arrays["base_color"] = -arrays["base_color"]
            build.write_arrays(name, arrays)
        build.write_json("model.json", first.json("model.json"))
        build.summary(method="gaussian-wardrobe", without=["sg"])
    config = EvaluateConfig(splits=("novel-view",), methods=("trained",), frame_step=4, pictures=0)
    current = stage.run(EvaluateInputs(subject), tmp_path / "a", config)
    assert current.summary["training"]["trained"]["without"] == ["sg"]
    other = stage.run(EvaluateInputs(subject), tmp_path / "b", replace(config, training=first.key[:6]))
    assert other.summary["training"]["trained"]["key"] == first.key
    good, bad = (result.summary["novel_view"]["trained"]["psnr_foreground"] for result in (other, current))
    assert good == pytest.approx(EXPECTED_PSNR, abs=1e-3) and bad < good - 5
    with workspace.build(BAKE_MAPS, {"new": 1}, {}) as baked:
        baked.summary(layers=[])
    with pytest.raises(UsageProblem, match="other maps"):
        stage.run(EvaluateInputs(subject), tmp_path / "c", replace(config, training=first.key))


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UsageProblem):
        check_config(EvaluateConfig(methods=("magic",)))

"""Try-on from files to film."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.render import stage as render
from stages.shared.errors import UsageProblem
from stages.shared.render_sequence.config import RenderConfig
from stages.tryon import stage
from tests.listening import Listener

SMALL = RenderConfig(width=48, height=64)


def _bundles(wardrobe: Path, *names: str) -> list[Path]:
    return [wardrobe / f"{name}.gwg" for name in names]


def test_film_frames_sheet_and_counts(wardrobe: Path, tmp_path: Path) -> None:
    out = tmp_path / "tryon"
    config = RenderConfig(width=48, height=64, passes=("labels", "depth", "layers"))
    result = stage.run(_bundles(wardrobe, "upper", "body", "lower"), wardrobe / "motion.npz", out, config)
    assert result.summary["layers"] == ["body", "lower", "upper"]
    assert result.summary["pictures"] == 5 and result.summary["swapped_texels"] == {}
    names = [f"{row:06d}.png" for row in range(5)]
    folders = ("frames", "labels", "depth", "layers/body", "layers/upper", "layers/lower")
    for folder in folders:
        assert sorted(path.name for path in (out / folder).iterdir()) == names, folder
    frame = cv2.imread(str(out / "frames/000002.png"), cv2.IMREAD_UNCHANGED)
    labels = cv2.imread(str(out / "labels/000002.png"), cv2.IMREAD_UNCHANGED)
    depth = cv2.imread(str(out / "depth/000002.png"), cv2.IMREAD_UNCHANGED)
    assert frame.shape == (64, 48, 4) and frame[0, 0, 3] == 0 and frame[..., 3].max() > 200
    assert {0, 3, 4, 255} >= set(np.unique(labels)) >= {3, 4, 255}
    assert depth.dtype == np.uint16 and 500 < depth[frame[..., 3] > 200].mean() < 10_000
    with av.open(str(out / result.summary["video"])) as container:
        assert sum(1 for _ in container.decode(video=0)) == 5
    assert (out / "contact_sheet.png").is_file()
    stored = json.loads((out / "result.json").read_text())
    assert stored["format"] == "gw-tryon" and stored["layers"] == ["body", "lower", "upper"]
    assert set(stored["bundles"]) == {"body", "lower", "upper"}
    assert "penetrated_pixels" in stored and stored["seconds"]["render"] > 0


def test_render_and_tryon_write_the_same_frames_and_the_same_results(wardrobe: Path, tmp_path: Path) -> None:
    bundles, motion = _bundles(wardrobe, "body", "upper"), wardrobe / "motion.npz"
    config = RenderConfig(width=48, height=64, frames="2:4")
    worn = stage.run(bundles, motion, tmp_path / "worn", config)
    rendered = render.run(bundles, motion, None, tmp_path / "rendered", config)
    assert worn.summary.keys() == rendered.summary.keys() >= {"restored_texels", "swapped_texels", "cameras"}
    first, second = (json.loads((result.path / "result.json").read_text()) for result in (worn, rendered))
    assert first.keys() == second.keys() and first["config"] == second["config"]
    frames = [(result.path / "frames/000003.png").read_bytes() for result in (worn, rendered)]
    assert frames[0] == frames[1]


def test_same_outfit_same_frames_whatever_the_order(wardrobe: Path, tmp_path: Path) -> None:
    config = RenderConfig(width=48, height=64, frames="2:3")
    for name, order in (("a", ("body", "lower", "upper")), ("b", ("upper", "lower", "body"))):
        stage.run(_bundles(wardrobe, *order), wardrobe / "motion.npz", tmp_path / name, config)
    first, second = ((tmp_path / name / "frames/000002.png").read_bytes() for name in "ab")
    assert first == second


def test_an_output_folder_with_other_things_is_left_alone(wardrobe: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(UsageProblem, match="something else"):
        stage.run(_bundles(wardrobe, "body"), wardrobe / "motion.npz", tmp_path, SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_command_with_its_errors(wardrobe: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    motion = ["--poses", str(wardrobe / "motion.npz"), "-o", str(out), "--preset", "tiny", "--frames", "0:2"]
    body, upper = str(wardrobe / "body.gwg"), str(wardrobe / "upper.gwg")
    dry = CliRunner().invoke(app, ["tryon", body, upper, *motion, "--dry-run", "--json"])
    assert dry.exit_code == 0 and json.loads(dry.stdout.splitlines()[-1])["result"]["dry_run"]
    assert not out.exists()
    done = CliRunner().invoke(app, ["tryon", body, upper, *motion, "--json", "--camera", "orbit"])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["pictures"] == 2
    (tmp_path / "broken.gwg").write_bytes(Path(upper).read_bytes()[:-1])
    for words, code in (
        (["tryon", upper, *motion], 2),
        (["tryon", body, body, *motion], 2),
        (["tryon", body, upper, upper, *motion], 2),
        (["tryon", body, str(tmp_path / "none.gwg"), *motion], 66),
        (["tryon", body, str(tmp_path / "broken.gwg"), *motion], 65),
        (["tryon", body, *motion, "--betas", "x"], 2),
        (["tryon", body, *motion, "--passes", "normals"], 2),
        (["tryon", body, *motion, "--camera", "spiral"], 2),
        (["tryon", body, "--poses", str(tmp_path / "none.npz"), "-o", str(out)], 66),
    ):
        failed = CliRunner().invoke(app, words)
        assert failed.exit_code == code, (words, failed.stderr)
        assert len(failed.stderr.strip().splitlines()[-3:]) == 3 and "fix:" in failed.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.gwg", "out"]


def test_an_interrupted_try_on_goes_on(wardrobe: Path, tmp_path: Path) -> None:
    """Frames that were finished are kept, and the result is the one of a single run."""
    bundles, poses = _bundles(wardrobe, "body", "upper"), wardrobe / "motion.npz"
    whole = stage.run(bundles, poses, tmp_path / "whole", SMALL)
    with pytest.raises(KeyboardInterrupt):
        stage.run(bundles, poses, tmp_path / "out", SMALL, Listener(stop=2))
    assert not (tmp_path / "out").exists()
    result = stage.run(bundles, poses, tmp_path / "out", SMALL)
    # Frames that were at work beside the second were finished too.
    assert 2 <= result.summary["kept_frames"] <= 4 and whole.summary["kept_frames"] == 0
    for name in ("frames/000001.png", "frames/000004.png", "contact_sheet.png", whole.summary["video"]):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]

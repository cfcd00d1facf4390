"""Render: subjects and outfits, camera paths and the cameras of a capture."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.render import stage
from stages.shared.artifacts import Workspace
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.render_image import render_image
from stages.shared.render_sequence.config import RenderConfig
from tests.shared.outfit.wardrobe import cameras, motion, outfit

SMALL = RenderConfig(width=48, height=64, frames="0:2")


def test_a_subject_in_its_own_motion(dressed_subject: Path, tmp_path: Path) -> None:
    result = stage.run([dressed_subject], None, None, tmp_path / "out", SMALL)
    assert result.summary["layers"] == ["body", "lower", "upper"] and result.summary["pictures"] == 2
    assert (tmp_path / "out/frames/000001.png").is_file() and (tmp_path / "out/film.mp4").is_file()


def test_cameras_of_a_capture(dressed_subject: Path, tmp_path: Path) -> None:
    """Every camera and frame that the capture has; the picture is the one of those cameras."""
    capture = dressed_subject.parent / "capture"
    out = tmp_path / "out"
    config = RenderConfig(take="other", frames="1:4:2", penetration=False)
    result = stage.run([dressed_subject], None, capture, out, config)
    assert result.summary["cameras"] == ["cam0", "cam1", "cam2"] and result.summary["pictures"] == 6
    frame = cv2.imread(str(out / "frames/cam2/000003.png"), cv2.IMREAD_UNCHANGED)
    shot = render_image(CachedPoser(outfit("body", "lower", "upper")).composite(motion(), 3), cameras()[2])
    assert np.array_equal(frame[..., [2, 1, 0, 3]], shot.straight())
    labels = cv2.imread(str(out / "labels/cam2/000003.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(labels, shot.labels)


def test_cameras_of_a_capture_whose_poses_were_fitted(dressed_subject: Path, tmp_path: Path) -> None:
    """The subject's own capture has the poses that were fitted; any other needs none with a motion."""
    shutil.copytree(dressed_subject.parent, tmp_path / "copy")
    subject, capture = tmp_path / "copy" / dressed_subject.name, tmp_path / "copy" / "capture"
    (tmp_path / "fitted").mkdir()
    for name in ("moves", "other"):
        shutil.move(capture / "takes" / name / "smpl_params.npz", tmp_path / "fitted" / f"{name}.npz")
    Workspace(subject).save_settings(capture=capture, fitted_poses=tmp_path / "fitted")
    config = RenderConfig(take="other", frames="1:2", penetration=False)
    result = stage.run([subject], None, capture, tmp_path / "out", config)
    assert result.summary["pictures"] == 3
    Workspace(subject).save_settings(capture=dressed_subject.parent / "capture", fitted_poses="")
    motion_file = tmp_path / "fitted" / "other.npz"
    assert stage.run([subject], motion_file, capture, tmp_path / "two", config).summary["pictures"] == 3
    with pytest.raises(MissingInput, match="no body poses"):
        stage.run([subject], None, capture, tmp_path / "three", config)


def test_one_camera_and_some_layers(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    capture = dressed_subject.parent / "capture"
    bundles = [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]
    config = RenderConfig(take="moves", camera="cam1", layers=("body", "upper"), frames="0:1")
    result = stage.run(bundles, None, capture, tmp_path / "out", config)
    assert result.summary["cameras"] == ["cam1"] and result.summary["layers"] == ["body", "upper"]
    labels = cv2.imread(str(tmp_path / "out/labels/cam1/000000.png"), cv2.IMREAD_UNCHANGED)
    assert 4 not in labels and 3 in labels


def test_garments_take_the_wearers_shape(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    """Shape 0 of the tubes is 1 cm along the normal: three of it make the shirt wider in every picture."""
    capture, seen = dressed_subject.parent / "capture", []
    for name, betas in (("own", ""), ("other", "3")):
        config = RenderConfig(take="moves", camera="cam0", layers=("upper",), frames="2:3", betas=betas)
        bundles = [wardrobe / "body.gwg", wardrobe / "upper.gwg"]
        stage.run(bundles, None, capture, tmp_path / name, config)
        frame = cv2.imread(str(tmp_path / name / "frames/cam0/000002.png"), cv2.IMREAD_UNCHANGED)
        seen.append(int((frame[..., 3] > 127).sum()))
    assert 1.1 * seen[0] < seen[1] < 1.5 * seen[0]


def test_orbit_walks_around(wardrobe: Path, tmp_path: Path) -> None:
    bundles = [wardrobe / "body.gwg", wardrobe / "upper.gwg"]
    config = RenderConfig(width=48, height=64, camera="orbit")
    result = stage.run(bundles, wardrobe / "motion.npz", None, tmp_path / "out", config)
    assert result.summary["cameras"] == ["orbit"] and result.summary["pictures"] == 5


def test_what_cannot_be_rendered(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    out, body = tmp_path / "out", wardrobe / "body.gwg"
    capture = dressed_subject.parent / "capture"
    with pytest.raises(MissingInput, match="no poses"):
        stage.run([body], None, None, out)
    with pytest.raises(UsageProblem, match="rendered as it is"):
        stage.run([dressed_subject, body], None, None, out)
    with pytest.raises(UsageProblem, match="no layer 'outer'"):
        stage.run([dressed_subject], None, None, out, RenderConfig(layers=("outer",)))
    with pytest.raises(UsageProblem, match="cam9"):
        stage.run([dressed_subject], None, capture, out, RenderConfig(camera="cam9"))
    assert not out.exists()


def test_command(wardrobe: Path, tmp_path: Path) -> None:
    words = ["render", str(wardrobe / "body.gwg"), "--poses", str(wardrobe / "motion.npz")]
    words += [
        "-o",
        str(tmp_path / "out"),
        "--preset",
        "tiny",
        "--frames",
        "0:2",
        "--passes",
        "depth",
        "--json",
    ]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["pictures"] == 2
    assert (tmp_path / "out/depth/000001.png").is_file()

"""Cameras that are held out at registration stay held out for the subject."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.views import views_by_split
from stages.shared.artifacts import Workspace
from stages.shared.capture import open_capture
from stages.shared.capture.open_capture import with_held_out
from stages.shared.capture.subject import open_subject_capture, remember_capture
from stages.shared.errors import MissingInput, UsageProblem
from tests.shared.capture import scene


def test_held_out_cameras_are_remembered_with_the_subject(tmp_path: Path) -> None:
    capture = open_capture(scene.write_animatable(tmp_path / "ball", "thuman4"))
    training = capture.takes[0].training_cameras
    workspace = Workspace(tmp_path / "subject")
    remember_capture(workspace, capture, hold_out=training[:2])
    take = open_subject_capture(workspace).takes[0]
    assert take.training_cameras == training[2:] and take.heldout_cameras == training[:2]


def test_cameras_that_cannot_be_held_out_are_refused(tmp_path: Path) -> None:
    capture = open_capture(scene.write_animatable(tmp_path / "ball", "thuman4"))
    with pytest.raises(UsageProblem, match="no camera called 'cam99'"):
        with_held_out(capture, ["cam99"])
    with pytest.raises(UsageProblem, match="left to learn from"):
        with_held_out(capture, capture.takes[0].training_cameras)


def test_without_options_what_the_capture_has_is_scored(tmp_path: Path) -> None:
    config = EvaluateConfig()
    no_test = open_capture(scene.write_native(tmp_path / "a"))
    assert set(views_by_split(no_test, "walk", config)) == {"novel_view"}
    both = open_capture(scene.write_native(tmp_path / "b", takes=("walk", "dance")))
    assert set(views_by_split(both, "walk", config)) == {"novel_pose", "novel_view"}
    neither = open_capture(scene.write_animatable(tmp_path / "c", "avatarrex"))
    name = neither.takes[0].name
    with pytest.raises(MissingInput, match="no test take"):
        views_by_split(neither, name, config)
    held = with_held_out(neither, neither.takes[0].training_cameras[:1])
    assert set(views_by_split(held, name, config)) == {"novel_view"}
    with pytest.raises(MissingInput, match="no test take"):
        views_by_split(no_test, "walk", EvaluateConfig(splits=("novel-pose",)))

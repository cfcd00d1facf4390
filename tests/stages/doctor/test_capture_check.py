"""Findings about a capture, each from a capture of a ball with that one defect."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.doctor.capture_check import check_capture, landmark_findings
from stages.shared.capture import Camera, open_capture
from stages.shared.capture.landmarks import Landmarks
from stages.shared.capture.native_writer import native_writer
from stages.shared.capture.take import Take
from tests.shared.capture import scene

SIDE = 420


def write(path: Path, defect: str = "", cameras: int = 6) -> Path:
    """Six cameras around a ball with a pattern; the defect is of cam1."""
    random = np.random.default_rng(0)
    pattern = random.integers(60, 200, (SIDE // 4, SIDE // 4, 3)).astype(np.uint8)
    pattern = cv2.resize(pattern, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    ring = scene.ring(cameras, SIDE, SIDE, 900.0)
    with native_writer(path, ring) as writer:
        take = writer.take("still", "train", None)
        for camera in ring:
            mask = np.asarray(scene.picture(camera)[1])
            image = np.where(mask[..., None] > 127, pattern, np.uint8(20))
            if camera.name == "cam1":
                image, mask = spoiled(image, mask, defect)
            take.view(camera.name, 0, image, mask, jpeg=False)
    return path


def spoiled(image: np.ndarray, mask: np.ndarray, defect: str) -> tuple[np.ndarray, np.ndarray]:
    if defect == "blurred":
        return cv2.GaussianBlur(image, (0, 0), 4), mask
    if defect == "is white":
        return np.where(mask[..., None] > 127, np.uint8(255), image), mask
    if defect == "inverted":
        return image, 255 - mask
    if defect == "of the mask":
        wrong = mask.copy()
        wrong[SIDE // 2 :] = 0
        return image, wrong
    return image, mask


def test_a_good_capture_has_no_finding(tmp_path: Path) -> None:
    assert check_capture(open_capture(write(tmp_path / "a"), poses_needed=False)) == []


@pytest.mark.parametrize("defect", ["blurred", "is white", "inverted"])
def test_each_defect_is_named_with_its_camera(defect: str, tmp_path: Path) -> None:
    findings = check_capture(open_capture(write(tmp_path / "a", defect), poses_needed=False))
    assert any(defect in line and "cam1" in line for line in findings), findings


def test_a_side_that_no_camera_sees(tmp_path: Path) -> None:
    root = write(tmp_path / "a", cameras=2)
    findings = check_capture(open_capture(root, poses_needed=False))
    assert any("180 degrees around the person" in line for line in findings), findings


def test_the_command_checks_captures(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["doctor", str(write(tmp_path / "a", "blurred"))])
    assert done.exit_code == 0 and "cam1: blurred" in done.stderr


def moving(cameras: list[Camera], late: dict[str, float], shift: dict[str, float]) -> tuple[Take, Landmarks]:
    """Landmarks that swing, seen by cameras of which some are late by frames or off by pixels."""
    random = np.random.default_rng(1)
    places = scene.CENTRE + random.uniform(-0.3, 0.3, (33, 3))

    def at(times: np.ndarray) -> np.ndarray:
        swing = np.stack(
            [0.2 * np.sin(times / 3), 0.1 * np.cos(times / 4), 0.15 * np.sin(times / 5)], axis=-1
        )
        return np.asarray(places + swing[:, None], np.float64)

    times = np.arange(30.0)
    pixels = np.stack([
        camera.project(at(times - late.get(camera.name, 0.0)))[0] + shift.get(camera.name, 0.0)
        for camera in cameras
    ])  # fmt: skip
    landmarks = Landmarks(
        tuple(camera.name for camera in cameras),
        np.arange(30),
        pixels.astype(np.float32),
        np.ones(pixels.shape[:3], np.float32),
        at(times).astype(np.float32),
        np.full((30, 33), 4, np.int32),
    )
    named = {camera.name: camera for camera in cameras}
    return Take("walk", "train", named, tuple(named), (), list(range(30)), scene.poses(30), {}), landmarks


def test_cameras_that_are_late_or_off() -> None:
    cameras = scene.ring(4, SIDE, SIDE, 900.0)
    assert landmark_findings(*moving(cameras, {}, {})) == []
    (line,) = landmark_findings(*moving(cameras, {"cam2": 2.0}, {}))
    assert "cam2: 1.9 frames behind" in line and "-0.06" in line
    (line,) = landmark_findings(*moving(cameras, {}, {"cam1": 15.0}))
    assert "cam1: landmarks are 21 pixels" in line

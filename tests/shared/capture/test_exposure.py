"""Colour gain and offset of cameras: found from a surface that several cameras see, removed and applied."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.capture import Take, open_capture
from stages.shared.capture.exposure import Exposure, exposures_json, read_exposures, solve_exposures
from stages.shared.errors import BadData
from tests.stages.dressed_body import dressed, write_capture

DARK = Exposure((0.8, 0.7, 0.9), (0.02, 0.0, 0.01))


def captured(folder: Path) -> Take:
    return open_capture(write_capture(folder, dressed(), cameras=8)).takes[0]


def darkened(take: Take, camera: str) -> None:
    """Write the picture of one camera as `DARK` shows it."""
    path = take.view(camera, 0).image
    picture = cv2.cvtColor(take.image(camera, 0), cv2.COLOR_RGB2BGR)
    gain, offset = np.array(DARK.gain)[::-1], np.array(DARK.offset)[::-1]
    cv2.imwrite(str(path), np.rint(255 * np.clip(picture / 255 * gain + offset, 0, 1)).astype(np.uint8))


def test_cameras_that_are_alike_are_left_as_they_are(tmp_path: Path) -> None:
    assert solve_exposures(captured(tmp_path / "capture"), 0, dressed().mesh) == {}


def test_a_camera_that_differs_is_found_and_freed_of_it(tmp_path: Path) -> None:
    take = captured(tmp_path / "capture")
    before = take.image("cam3", 0).astype(float)
    darkened(take, "cam3")
    after = take.image("cam3", 0)
    found = solve_exposures(take, 0, dressed().mesh)
    assert list(found) == ["cam3"]
    inside = take.mask("cam3", 0) > 250
    wrong = np.abs(after - before)[inside].mean()
    assert np.abs(found["cam3"].removed(after) - before)[inside].mean() < 0.15 * wrong


def test_what_is_removed_can_be_applied_again() -> None:
    colors = np.random.default_rng(0).integers(20, 180, (5, 4, 3), np.uint8)
    shown = DARK.applied(colors, np.ones((5, 4)))
    assert np.abs(DARK.removed(shown).astype(int) - colors).max() <= 1
    nothing = DARK.applied(np.zeros((5, 4, 3), np.uint8), np.zeros((5, 4)))
    assert not nothing.any(), "where there is nobody the offset adds nothing"


def test_exposures_are_read_as_they_were_written() -> None:
    assert read_exposures(exposures_json({"cam3": DARK}), "here") == {"cam3": DARK}
    for wrong in ([], {"cam3": {"gain": [1, 1, 1]}}, {"cam3": {"gain": [0, 1, 1], "offset": [0, 0, 0]}}):
        with pytest.raises(BadData, match="no exposures"):
            read_exposures(wrong, "here")

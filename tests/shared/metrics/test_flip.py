"""FLIP against its authors' own implementation, and against what must hold for any difference."""

from __future__ import annotations

import cv2
import flip_evaluator
import numpy as np
import pytest

from stages.shared.errors import BadData
from stages.shared.metrics.flip import REACH, flip, flip_map


def _pictures(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Blotches, and the same with noise, another colour in a corner, and an edge moved."""
    random = np.random.default_rng(seed)
    truth = cv2.GaussianBlur(random.integers(0, 256, (70, 60, 3)).astype(np.uint8), (0, 0), 2)
    truth = np.clip((truth.astype(int) - 128) * 4 + 128, 0, 255)
    truth[20:50, 10:40] = (200, 30, 30)
    prediction = truth + random.normal(0, 5 + 10 * seed, truth.shape)
    prediction[20:50, 38:44] = (200, 30, 30)
    prediction[:10, :10] = (0, 255, 0)
    return np.clip(prediction, 0, 255).astype(np.uint8), truth.astype(np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_map_is_that_of_the_authors(seed: int) -> None:
    prediction, truth = _pictures(seed)
    one, other = ((picture / 255).astype(np.float32) for picture in (truth, prediction))
    expected, mean, _ = flip_evaluator.evaluate(one, other, "LDR", True, False, True, {})
    found = flip_map(prediction, truth)
    assert found.shape == (70, 60) and np.abs(found - expected[..., 0]).max() < 1e-4
    assert flip(prediction, truth) == pytest.approx(mean, abs=1e-5)


def test_region_sees_its_surroundings_and_nothing_beyond() -> None:
    prediction, truth = _pictures(1)
    inside = np.zeros(truth.shape[:2], bool)
    inside[30:40, 20:35] = True
    expected = float(flip_map(prediction, truth)[inside].mean())
    assert flip(prediction, truth, inside) == pytest.approx(expected, abs=1e-6)
    prediction[: 30 - REACH] = 0
    assert flip(prediction, truth, inside) == pytest.approx(expected, abs=1e-6)


def test_equal_opposite_and_nothing() -> None:
    _, truth = _pictures(0)
    assert flip(truth, truth) == 0
    assert flip(truth, truth, np.zeros(truth.shape[:2], bool)) is None
    black, white = np.zeros_like(truth), np.full_like(truth, 255)
    assert 0.9 < (flip(black, white) or 0) <= 1.001
    with pytest.raises(BadData):
        flip(truth[1:], truth)

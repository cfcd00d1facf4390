"""Triangulation, consistency of masks, and masks from an empty scene, each against a known answer."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared.errors import MissingInput
from stages.shared.vision.background import background_model, mask_from_background
from stages.shared.vision.consistency import consistent_masks
from stages.shared.vision.edges import largest_person, sharpened_mask
from stages.shared.vision.models import DETECTOR, VARIABLE, model_bytes, problem
from stages.shared.vision.people import Square
from stages.shared.vision.triangulate import SIDES, triangulate
from tests.shared.capture import scene

COUNT = 33


def landmarks(frames: int = 3) -> np.ndarray:
    """(T, 33, 3): a person's left at +x, all within the ball's reach."""
    random = np.random.default_rng(2)
    points = scene.CENTRE + random.uniform(-0.4, 0.4, (frames, COUNT, 3))
    for left, right in SIDES:
        points[:, left, 0] = scene.CENTRE[0] + 0.2
        points[:, right, 0] = scene.CENTRE[0] - 0.2
    return points


def test_landmarks_are_triangulated_though_a_view_is_wrong() -> None:
    cameras, points = scene.ring(6, 256, 192, 280.0), landmarks()
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    pixels[2, :, 5] += 60.0
    pixels[4, 1, 7] = np.nan
    visibility = np.ones(pixels.shape[:3])
    result = triangulate(cameras, pixels, visibility)
    np.testing.assert_allclose(result.points, points, atol=2e-3)
    assert (result.views[:, 5] == 5).all() and result.views[1, 7] == 5
    assert not result.swapped.any()
    assert result.pixels[2, :, 5].min() > 50 and np.nanmedian(result.pixels) < 0.1


def test_a_view_from_behind_that_confuses_left_and_right() -> None:
    cameras, points = scene.ring(5, 256, 192, 280.0), landmarks()
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    order = np.arange(COUNT)
    for left, right in SIDES:
        order[left], order[right] = right, left
    pixels[3, 1] = pixels[3, 1, order]
    result = triangulate(cameras, pixels, np.ones(pixels.shape[:3]))
    assert np.argwhere(result.swapped).tolist() == [[3, 1]]
    np.testing.assert_allclose(result.points, points, atol=1e-6)


def test_what_one_view_sees_is_unknown() -> None:
    cameras, points = scene.ring(4, 256, 192, 280.0), landmarks(1)
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    visibility = np.zeros(pixels.shape[:3])
    visibility[0] = 1
    assert np.isnan(triangulate(cameras, pixels, visibility).points).all()


def test_views_correct_each_other() -> None:
    cameras = scene.ring(12, 128, 96, 140.0)
    masks = [np.asarray(scene.picture(camera)[1]) for camera in cameras]
    truth = masks[0] > 127
    spoiled = [mask.copy() for mask in masks]
    spoiled[0][2:10, 2:10] = 255  # furniture
    spoiled[0][44:52, 60:68] = 0  # a hole
    corrected = consistent_masks(cameras, spoiled)
    assert not corrected[0][2:10, 2:10].any()
    assert (corrected[0][44:52, 60:68] == 255).all()
    for number, mask in enumerate(corrected):
        good = masks[number] > 127
        assert ((mask > 127) & good).sum() / ((mask > 127) | good).sum() > 0.95
    assert truth.any()
    few = consistent_masks(cameras[:3], spoiled[:3])
    np.testing.assert_array_equal(few[0], spoiled[0])  # three views decide nothing


def test_an_empty_scene_gives_the_mask_and_its_shadow_does_not() -> None:
    random = np.random.default_rng(1)
    wall = random.integers(90, 160, (96, 128, 3)).astype(np.float32)
    empty = [np.clip(wall + random.normal(0, 2, wall.shape), 0, 255).astype(np.uint8) for _ in range(5)]
    picture = np.clip(wall + random.normal(0, 2, wall.shape), 0, 255)
    picture[60:80, 70:110] *= 0.6  # shadow
    picture[20:80, 40:70] = (200, 40, 40)
    mask = mask_from_background(picture.astype(np.uint8), *background_model(empty))
    person = np.zeros((96, 128), bool)
    person[20:80, 40:70] = True
    assert ((mask > 127) & person).sum() / ((mask > 127) | person).sum() > 0.95


def test_edges_move_to_edges_of_the_picture() -> None:
    random = np.random.default_rng(3)
    picture = random.normal(60, 6, (400, 300, 3))
    picture[50:350, 100:200] = random.normal((190, 120, 90), 6, (300, 100, 3))
    truth = np.zeros((400, 300), bool)
    truth[50:350, 100:200] = True
    rough = np.zeros((400, 300), np.uint8)
    rough[48:352, 97:203] = 255
    sharp = sharpened_mask(np.clip(picture, 0, 255).astype(np.uint8), rough) > 127
    before = ((rough > 127) & truth).sum() / ((rough > 127) | truth).sum()
    assert (sharp & truth).sum() / (sharp | truth).sum() > max(0.99, before + 0.02)


def test_specks_go() -> None:
    mask = np.zeros((60, 60), np.uint8)
    mask[10:50, 10:30], mask[55:57, 55:57] = 255, 255
    cleaned = largest_person(mask)
    assert not cleaned[50:].any() and cleaned[10:50, 10:30].all()


def test_a_turned_square_and_back() -> None:
    square = Square(50.0, 40.0, 64.0, 0.5)
    matrix = square.picture_from_square(32)
    middle = matrix[:, :2] @ [15.5, 15.5] + matrix[:, 2] + 0.5
    np.testing.assert_allclose(middle, [50.0, 40.0])
    up = matrix[:, :2] @ [0.0, -1.0]
    np.testing.assert_allclose(up, 2 * np.array([np.sin(0.5), -np.cos(0.5)]))


def test_where_networks_are_looked_for(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(MissingInput, match="not here"):
        model_bytes(DETECTOR)
    assert "not here" in str(problem())

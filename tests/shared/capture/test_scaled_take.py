"""Pictures at the detail of a texel: sizes, contents, and what is left alone."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.capture import open_capture
from stages.shared.capture.images import read_image
from stages.shared.capture.scaled_take import (
    ScaledTake,
    commonest_ids,
    picture_scales,
    reduced_to,
    scaled_for_texels,
    texel_scale,
)
from tests.shared.capture import scene


def test_a_texel_covers_two_to_three_pixels_of_a_large_picture() -> None:
    camera = scene.ring(1, 4096, 4096, 5200.0)[0]  # 2 m away: 23.4 px for a texel of 9 mm
    scale = texel_scale(camera, scene.CENTRE, 0.009)
    assert 2 <= scale * 5200 * 0.009 / 2 <= 3
    assert texel_scale(camera, scene.CENTRE, 0.0012) == 1.0, "a reduction by a fifth is not worth it"
    assert texel_scale(camera, scene.CENTRE, 0.2) == 512 / 4096, "512 pixels are left"
    assert texel_scale(scene.ring(1, 512, 512, 650.0)[0], scene.CENTRE, 0.2) == 1.0


@pytest.mark.parametrize("jpeg", [False, True])
def test_pictures_masks_and_labels_are_those_of_the_scaled_camera(tmp_path: Path, jpeg: bool) -> None:
    cameras = scene.ring(1, 800, 600, 900.0)
    with scene.native_writer(tmp_path / "ball", cameras) as writer:
        written = writer.take("walk", "train", scene.poses(1))
        written.view("cam0", 0, *scene.picture(cameras[0]), jpeg=jpeg)
    take = open_capture(tmp_path / "ball").takes[0]
    small = reduced_to(take, 200)
    assert isinstance(small, ScaledTake) and picture_scales(small) == [0.25, 0.25]
    image, mask, labels = scene.picture(small.camera("cam0"))
    inside = cv2.erode((mask > 0).astype(np.uint8), np.ones((5, 5))) > 0
    assert np.abs(small.image("cam0", 0).astype(int) - image)[inside].max() <= (8 if jpeg else 2)
    assert ((small.mask("cam0", 0) > 127) != (mask > 0)).mean() < 0.002
    ids = small.labels("cam0", 0)
    assert ids is not None and (ids != labels).mean() < 0.01 and set(np.unique(ids)) == {3, 4, 255}
    assert small.image("cam0", 0) is small.image("cam0", 0), "read once"
    smaller = reduced_to(small, 100)
    assert picture_scales(smaller) == [0.125, 0.125] and smaller.image("cam0", 0).shape == (75, 100, 3)
    assert smaller.mask("cam0", 0).shape == (75, 100)


def test_a_take_of_ordinary_pictures_stays_as_it_is(tmp_path: Path) -> None:
    take = open_capture(scene.write_native(tmp_path / "ball", frames=1)).takes[0]
    assert scaled_for_texels(take, scene.CENTRE, 0.009) is take and picture_scales(take) == [1.0, 1.0]
    half = scaled_for_texels(take, scene.CENTRE, 0.009, scale=0.5)
    assert half.image("cam0", 0).shape == (24, 32, 3)


def test_a_jpeg_is_decoded_at_a_part_of_its_size(tmp_path: Path) -> None:
    image = cv2.resize(np.random.default_rng(0).integers(0, 255, (9, 11, 3), np.uint8), (110, 90))
    assert cv2.imwrite(str(tmp_path / "a.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    for step in (2, 4, 8):
        small = read_image(tmp_path / "a.jpg", step)
        assert small.shape == (-(-90 // step), -(-110 // step), 3)
    mean = read_image(tmp_path / "a.jpg", 2).mean(axis=(0, 1))
    assert np.abs(mean - image[..., ::-1].mean(axis=(0, 1))).max() < 2


def test_labels_are_reduced_by_majority() -> None:
    ids = np.array([[1, 1, 4, 255], [1, 2, 4, 4]], np.uint8)
    assert commonest_ids(ids, (2, 1)).tolist() == [[1, 4]]

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.shared.capture.calibration import checked_camera
from stages.shared.capture.camera import Camera
from stages.shared.errors import BadData
from tests.shared.capture.scene import ring


def test_projects_as_opencv_does() -> None:
    points = np.random.default_rng(0).normal(0, 0.3, (50, 3)) + [0, 1, 0]
    for camera in ring():
        vector, _ = cv2.Rodrigues(camera.camera_from_world[:3, :3])
        expected, _ = cv2.projectPoints(
            points, vector, camera.camera_from_world[:3, 3], camera.intrinsics, None
        )
        pixels, depth = camera.project(points)
        np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)
        assert (depth > 1).all()


def test_points_behind_have_no_pixel() -> None:
    camera = ring()[0]
    pixels, depth = camera.project(camera.centre + [[0, 0, 1.0], [0, 0, -1.0]])
    assert np.isnan(pixels[0]).all() and np.isfinite(pixels[1]).all()
    assert depth[0] < 0 < depth[1]
    assert not camera.in_view(pixels)[0]


def test_rays_go_through_pixel_centres() -> None:
    camera = ring()[2]
    origin, directions = camera.rays()
    pixels, depth = camera.project(origin + 3.0 * directions)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-9)
    np.testing.assert_allclose(depth, 3.0)


def test_crop_and_scale_keep_the_picture() -> None:
    camera, point = ring()[1], np.array([0.1, 1.1, 0.05])
    pixel = camera.project(point)[0]
    cropped = camera.crop((10, 5, 50, 40))
    assert (cropped.width, cropped.height) == (40, 35)
    np.testing.assert_allclose(cropped.project(point)[0], pixel - [10, 5])
    half = camera.scaled(0.5)
    np.testing.assert_allclose(half.project(point)[0], pixel / 2)
    odd = camera.scaled(0.3)  # 19.2 x 14.4 pixels become 19 x 14
    np.testing.assert_allclose(odd.project(point)[0], pixel * [19 / 64, 14 / 48])
    with pytest.raises(ValueError, match="empty box"):
        camera.crop((10, 5, 10, 40))


def test_inverse_and_centre() -> None:
    for camera in ring():
        np.testing.assert_allclose(camera.world_from_camera @ camera.camera_from_world, np.eye(4), atol=1e-12)
        assert np.hypot(camera.centre[0], camera.centre[2]) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"intrinsics": np.full((3, 3), np.nan)}, "NaN"),
        ({"camera_from_world": np.diag([1, 1, 2.0, 1])}, "no rotation"),
        ({"camera_from_world": np.diag([1, 1, -1.0, 1])}, "no rotation"),
        ({"intrinsics": np.diag([-50.0, 50, 1])}, "focal length"),
        ({"intrinsics": np.array([[50.0, 0, 9], [0, 50, 9], [0, 0.1, 1]])}, "last row"),
        ({"width": 0}, "0 x 48"),
        ({"camera_from_world": np.eye(3)}, "wrong shape"),
    ],
)
def test_refuses_broken_calibrations(change: dict, says: str) -> None:
    camera = ring()[0]
    values = {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": camera.intrinsics,
        "camera_from_world": camera.camera_from_world,
    }
    assert isinstance(checked_camera("c", **values, where="here"), Camera)
    with pytest.raises(BadData) as caught:
        checked_camera("c", **{**values, **change}, where="here")
    assert says in caught.value.what and caught.value.where == "here"

"""From a camera with a lens to a pinhole, and from its pictures to the pinhole's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.calibration.model import LensCamera, Matrix
from stages.shared.capture.camera import Camera

_Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Undistortion:
    """How the pixels of a pinhole camera are taken from a distorted picture.

    Attributes:
        camera: the pinhole, without skew, of the same size; world and unit of the calibration.
        columns, rows: (H, W) f32 where each pixel lies in the distorted picture, centres at integers; None
            where the picture needs no change.
    """

    camera: Camera
    columns: NDArray[np.float32] | None = None
    rows: NDArray[np.float32] | None = None

    def picture(self, image: _Image) -> _Image:
        """(H, W, ...) u8 as the pinhole sees it; black outside of the picture."""
        return self._remapped(image, cv2.INTER_CUBIC)

    def mask(self, mask: _Image) -> _Image:
        """(H, W) u8 coverage as the pinhole sees it; 0 outside of the picture."""
        return self._remapped(mask, cv2.INTER_LINEAR)

    def labels(self, labels: _Image, outside: int) -> _Image:
        """(H, W) u8 ids as the pinhole sees them."""
        return self._remapped(labels, cv2.INTER_NEAREST, outside)

    def _remapped(self, image: _Image, way: int, outside: int = 0) -> _Image:
        if self.columns is None or self.rows is None:
            return image
        border = (outside,) * 4
        result = cv2.remap(image, self.columns, self.rows, way, None, cv2.BORDER_CONSTANT, border)
        return np.asarray(result, np.uint8)


def undistortion(lens: LensCamera, alpha: float = 0.0) -> Undistortion:
    """The pinhole of a lens camera, and the map to it.

    Arguments:
        lens: with a known size.
        alpha: 0 keeps only pixels that the distorted picture has, 1 keeps the whole distorted picture.
    """
    assert lens.size is not None
    width, height = lens.size
    if not len(lens.distortion) and abs(lens.intrinsics[0, 1]) < 1e-9:
        return Undistortion(Camera(lens.name, width, height, lens.intrinsics, lens.camera_from_world))
    source = lens.intrinsics.copy()
    source[:2, 2] -= 0.5  # OpenCV counts pixel centres as integers
    skew, source[0, 1] = source[0, 1], 0.0
    target = _pinhole(lens, source, alpha)
    initialise = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    distortion = lens.distortion if len(lens.distortion) else np.zeros(4)
    columns, rows = initialise(source, distortion, np.eye(3), target, (width, height), cv2.CV_32FC1)
    columns = columns + np.float32(skew / source[1, 1]) * (rows - np.float32(source[1, 2]))
    target[:2, 2] += 0.5
    camera = Camera(lens.name, width, height, target, lens.camera_from_world)
    return Undistortion(camera, np.asarray(columns, np.float32), np.asarray(rows, np.float32))


def _pinhole(lens: LensCamera, source: Matrix, alpha: float) -> Matrix:
    """(3, 3) intrinsics of the undistorted picture, pixel centres at integers."""
    assert lens.size is not None
    if not len(lens.distortion):
        return np.array(source, np.float64)
    if lens.fisheye:
        straight = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            source, lens.distortion, lens.size, np.eye(3), balance=alpha
        )
    else:
        straight = cv2.getOptimalNewCameraMatrix(source, lens.distortion, lens.size, alpha)[0]
    matrix: Matrix = np.array(straight, np.float64)
    matrix[0, 1] = 0.0
    return matrix

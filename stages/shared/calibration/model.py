"""A camera as calibration tools state it: skew, lens distortion, any unit of length, any up axis."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.errors import BadData

Matrix = NDArray[np.float64]
DISTORTION_COUNTS = (0, 4, 5, 8, 12)  # OpenCV's vectors k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]
FISHEYE_COUNT = 4
ROTATION_TOLERANCE = 1e-3
_SAME_RATIO = 0.004  # sides that differ by less are the same shape, resized


@dataclass(frozen=True, eq=False)
class LensCamera:
    """One calibrated camera with its lens.

    Attributes:
        name: as the calibration calls it.
        size: width and height in pixels; None where the file does not state it.
        intrinsics: (3, 3) f64 pixels, pixel centres at integer + 0.5, skew allowed.
        distortion: (D,) f64 in OpenCV's order, D of `DISTORTION_COUNTS`; 4 for a fisheye.
        fisheye: whether `distortion` is of OpenCV's fisheye model.
        camera_from_world: (4, 4) f64, x right, y down, z forward; translation in the calibration's unit.
    """

    name: str
    size: tuple[int, int] | None
    intrinsics: Matrix
    camera_from_world: Matrix
    distortion: Matrix = field(default_factory=lambda: np.zeros(0))
    fisheye: bool = False

    @property
    def centre(self) -> Matrix:
        """(3,) f64 where the camera stands, in the calibration's world and unit."""
        rotation = self.camera_from_world[:3, :3]
        return np.asarray(-rotation.T @ self.camera_from_world[:3, 3], np.float64)

    def resized(self, width: int, height: int, bars: int = 0) -> LensCamera:
        """The camera of the picture after a resize to width x height, `bars` pixels of which are added at
        the top and at the bottom.

        Raises:
            BadData: another shape than the calibrated picture's.
        """
        assert self.size is not None
        across, down = width / self.size[0], (height - 2 * bars) / self.size[1]
        if abs(across / down - 1) > _SAME_RATIO:
            raise BadData(
                f"The picture has {width} x {height} pixels, its calibration {self.size[0]} x "
                f"{self.size[1]}: another shape.",
                f"camera {self.name}",
                "Give the pictures that were calibrated, or the calibration of these pictures.",
            )
        intrinsics = np.diag([across, down, 1.0]) @ self.intrinsics
        intrinsics[1, 2] += bars
        return replace(self, size=(width, height), intrinsics=intrinsics)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The cameras of one file or folder.

    Attributes:
        cameras: name to camera, in the file's order.
        kind: what was read, for people ("Qualisys", "COLMAP, text").
        files: what was read.
        metres_per_unit: None where the format does not fix the unit.
        up: (3,) the world's up direction, None where the format does not fix it.
        notes: what was assumed, in sentences.
    """

    cameras: dict[str, LensCamera]
    kind: str
    files: tuple[str, ...]
    metres_per_unit: float | None = None
    up: Matrix | None = None
    notes: tuple[str, ...] = ()


def lens_camera(
    name: str,
    size: tuple[int, int] | None,
    intrinsics: ArrayLike,
    camera_from_world: ArrayLike,
    where: str,
    distortion: ArrayLike = (),
    fisheye: bool = False,
    centres_at_integers: bool = True,
) -> LensCamera:
    """A camera out of a file, every number checked.

    Arguments:
        centres_at_integers: whether the file counts pixel centres as integers (OpenCV), not as integer + 0.5.

    Raises:
        BadData: wrong shapes, numbers that are not finite, no rotation, a distortion model that is not known.
    """

    def refuse(what: str) -> BadData:
        return BadData(f"Camera {name}: {what}.", where, "Correct the calibration, or leave this camera out.")

    try:
        matrix = np.array(intrinsics, np.float64).reshape(3, 3)
        rigid = np.eye(4)
        pose = np.array(camera_from_world, np.float64)
        rigid[: pose.shape[0]] = pose
        coefficients = np.array(distortion, np.float64).reshape(-1)
    except (ValueError, TypeError, IndexError) as error:
        raise refuse(f"the calibration has the wrong shape ({error})") from error
    for values in (matrix, rigid, coefficients):
        if not np.isfinite(values).all():
            raise refuse("the calibration contains NaN or infinity")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise refuse("a focal length is not positive")
    if np.abs(matrix[[1, 2, 2], [0, 0, 1]]).max() > 1e-9 or abs(matrix[2, 2] - 1) > 1e-9:
        raise refuse("the intrinsics are not an upper triangle with 1 in the last place")
    off = np.abs(rigid[:3, :3] @ rigid[:3, :3].T - np.eye(3)).max()
    if off > ROTATION_TOLERANCE or np.linalg.det(rigid[:3, :3]) < 0:
        raise refuse(f"its matrix is no rotation (off by {off:.2g})")
    known = (FISHEYE_COUNT,) if fisheye else DISTORTION_COUNTS
    if len(coefficients) not in known:
        padded = next((count for count in known if count > len(coefficients)), None)
        if padded is None or (fisheye and len(coefficients) > FISHEYE_COUNT):
            raise refuse(f"{len(coefficients)} distortion coefficients; {max(known)} at most are known")
        coefficients = np.pad(coefficients, (0, padded - len(coefficients)))
    if not coefficients.any() and not fisheye:
        coefficients = np.zeros(0)
    if centres_at_integers:
        matrix[:2, 2] += 0.5
    return LensCamera(name, size, matrix, rigid, coefficients, fisheye)


def pose_from(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """(4, 4) out of a rotation (3, 3) and a translation (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(rotation, np.float64).reshape(3, 3)
    matrix[:3, 3] = np.asarray(translation, np.float64).reshape(3)
    return matrix

"""One schema for cameras out of files: every field is used or refused, none is skipped.

A calibration that is read half is worse than none. Lens distortion, skew, sides in fractions of a pixel and
text where numbers belong change what a camera sees, and nothing later would notice.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.capture.camera import MAX_SIDE, Camera, rotation_error
from stages.shared.errors import BadData

_DISTORTION = re.compile(r"dist.*|rectif.*|k[1-9]|p[12]|radial.*|tangential.*|xi|omega", re.IGNORECASE)
_ROTATION_TOLERANCE = 1e-3
_LARGEST_SHIFT = 0.05  # pixels: skew that moves no pixel of the image farther is rounding


def checked_camera(
    name: str, width: Any, height: Any, intrinsics: ArrayLike, camera_from_world: ArrayLike, where: str
) -> Camera:
    """A camera out of a file, with every number looked at.

    Raises:
        BadData: sides that are not whole numbers in range, text or truth values for numbers, NaN, a focal
            length that is not positive, skew, last rows other than 0 0 1 and 0 0 0 1, a matrix that is not
            a rotation.
    """

    def refuse(what: str) -> BadData:
        return BadData(f"Camera {name}: {what}.", where, "Correct the calibration, or leave this camera out.")

    sides = [whole_number(side) for side in (width, height)]
    if not all(side is not None and 0 < side <= MAX_SIDE for side in sides):
        raise refuse(f"an image of {width!r} x {height!r} pixels")
    matrix, place = numbers(intrinsics), numbers(camera_from_world)
    if matrix is None or matrix.shape != (3, 3) or place is None or place.shape not in ((3, 4), (4, 4)):
        raise refuse("the calibration has the wrong shape, or holds something else than numbers")
    if not (np.isfinite(matrix).all() and np.isfinite(place).all()):
        raise refuse("the calibration contains NaN or infinity")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise refuse("a focal length is not positive")
    if not np.allclose(matrix[2], [0, 0, 1], atol=1e-9):
        raise refuse("the last row of the intrinsics is not 0 0 1")
    if len(place) == 4 and not np.allclose(place[3], [0, 0, 0, 1], atol=1e-9):
        raise refuse("the last row of its matrix is not 0 0 0 1")
    width, height = int(sides[0] or 0), int(sides[1] or 0)
    shift = abs(matrix[0, 1]) * height / matrix[1, 1] + abs(matrix[1, 0]) * width / matrix[0, 0]
    if shift > _LARGEST_SHIFT:
        raise refuse(f"its intrinsics have skew ({matrix[0, 1]:.4g}, {matrix[1, 0]:.4g}), which is not used")
    matrix[0, 1] = matrix[1, 0] = 0.0
    off, determinant = rotation_error(place[:3, :3])
    if off > _ROTATION_TOLERANCE or determinant < 0:
        raise refuse(f"its matrix is no rotation (off by {off:.2g}, determinant {determinant:.3g})")
    return Camera(name, width, height, matrix, place)


def refuse_unknown(entry: Mapping[str, Any], known: Iterable[str], where: str, what: str) -> None:
    """Refuse fields that are not read: they may change what the others mean.

    Fields of lens distortion may be there with nothing but zeros in them.

    Raises:
        BadData: naming the field.
    """
    for name in entry:
        if name in set(known):
            continue
        if _DISTORTION.fullmatch(name):
            values = numbers(entry[name])
            if entry[name] is None or (values is not None and not values.any()):
                continue
            raise BadData(
                f"{what} has lens distortion ({name}), which is not applied.",
                where,
                "Undistort the images and masks first, and write the calibration of the undistorted images.",
            )
        raise BadData(
            f"{what} has a field {name[:60]!r} that is not known.",
            where,
            "Take it out, if the other fields mean the same without it. Known are: " + ", ".join(known) + ".",
        )


def whole_number(value: Any) -> int | None:
    """An integer, also one that is stored as 448.0; None for anything else, truth values included."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return int(value) if np.isfinite(value) and float(value).is_integer() else None


def truth_value(entry: Mapping[str, Any], name: str, where: str) -> bool:
    """The truth value of a field, false where it is absent. Raises BadData for text and numbers."""
    value = entry.get(name, False)
    if not isinstance(value, bool):
        raise BadData(
            f"{name} is {value!r}, not true or false.", where, "Write true or false without quotes."
        )
    return value


def positive_rate(entry: Mapping[str, Any], name: str, where: str) -> float | None:
    """Frames per second in a field; None where it is absent. Raises BadData for anything but a number > 0."""
    value = entry.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e5:
        raise BadData(f"{name} is not a positive number.", where, "Write the frame rate as a number.")
    return float(value)


def numbers(value: Any) -> NDArray[np.float64] | None:
    """Nested lists or an array of real numbers as float64; None where anything else is among them."""
    if isinstance(value, list | tuple) and not _only_numbers(value):
        return None
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return None
    if array.dtype.kind not in "iuf" or array.size > 1_000_000:
        return None
    return np.array(array, dtype=np.float64)


def _only_numbers(values: list[Any] | tuple[Any, ...]) -> bool:
    return all(
        _only_numbers(value)
        if isinstance(value, list | tuple)
        else isinstance(value, int | float | np.number | np.ndarray) and not isinstance(value, bool)
        for value in values
    )

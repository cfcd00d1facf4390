"""Images and masks from PNG and JPEG files: header first, then pixels, then the size the camera promises."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.png import check_picture, damaged
from stages.shared.errors import BadData, MissingInput, StorageFailure

Image = NDArray[np.uint8]


def read_image(path: Path) -> Image:
    """An RGB picture (H, W, 3) u8, sRGB.

    Raises:
        MissingInput: there is no such file.
        BadData: not a whole PNG or JPEG.
    """
    image = decode(read_bytes(path), path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.ascontiguousarray(image[..., ::-1])


def read_mask(path: Path) -> Image:
    """Coverage (H, W) u8, 0 outside to 255 inside: the first channel of the file.

    Masks stored as 0 and 1 are stretched to 0 and 255.

    Raises:
        MissingInput: there is no such file.
        BadData: not a whole PNG or JPEG.
    """
    image = decode(read_bytes(path), path)
    if image.ndim == 3:
        image = image[..., 2]  # OpenCV keeps red last
    mask = np.ascontiguousarray(image)
    if mask.size and mask.max() == 1:
        mask = mask * np.uint8(255)
    return mask


def read_bytes(path: Path) -> bytes:
    """A file's content, with errors that name it."""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise MissingInput(
            "An image of the capture is not there.", str(path), "Copy the capture again."
        ) from error
    except OSError as error:
        raise StorageFailure(
            f"Reading failed: {error.strerror}.", str(path), "Check the disk and the permissions."
        ) from error


def decode(
    data: bytes, path: Path, mode: int = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
) -> Image:
    """Pixels of a PNG or JPEG in OpenCV's channel order, 8 bits a channel: (H, W) or (H, W, 3 or 4) u8."""
    width, height = check_picture(data, path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise damaged(path, f"it cannot be decoded ({error.err})") from error
    if image is None or image.shape[:2] != (height, width):
        raise damaged(path, "it cannot be decoded")
    pixels = np.right_shift(image, 8) if image.dtype == np.uint16 else image
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    return pixels.astype(np.uint8, copy=False)


def check_size(image: Image, width: int, height: int, path: Path) -> Image:
    """The image, if it has the size that its camera was calibrated for."""
    if image.shape[:2] != (height, width):
        raise BadData(
            f"The image has {image.shape[1]} x {image.shape[0]} pixels, its camera {width} x {height}.",
            str(path),
            "Use the calibration that belongs to this image size.",
        )
    return image

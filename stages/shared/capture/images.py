"""Images and masks from PNG and JPEG files: header first, then pixels, then the size the camera promises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.image_files import check_jpeg_data, check_picture, damaged
from stages.shared.errors import BadData
from stages.shared.input_files import read_input

Image = NDArray[np.uint8]

_MAX_FILE_BYTES = 256 << 20
_UPRIGHT = cv2.IMREAD_IGNORE_ORIENTATION
_REDUCED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
JPEG_STEPS = tuple(_REDUCED)


def read_image(path: Path, step: int = 1) -> Image:
    """An RGB picture (H, W, 3) u8, sRGB.

    Arguments:
        step: 2, 4 or 8 reads the picture at a half, a quarter or an eighth of its size, sides rounded up. A
            JPEG is decoded at that size, which takes a fraction of the time and memory.

    Raises:
        MissingInput: there is no such file.
        BadData: not a whole PNG or JPEG.
    """
    image = decode(read_bytes(path), path, _REDUCED[step] | _UPRIGHT, step)
    return np.ascontiguousarray(image[..., ::-1])


def read_mask(path: Path) -> Image:
    """Coverage (H, W) u8, 0 outside to 255 inside.

    It is the alpha channel where the file has one that is not constant, else the first channel. Masks stored
    as 0 and 1 are stretched to 0 and 255; 16-bit masks are read by their values where none is above 255,
    else scaled.

    Raises:
        MissingInput: there is no such file.
        BadData: not a whole PNG or JPEG.
    """
    image = decode_as_stored(read_bytes(path), path)
    if image.ndim == 3 and image.shape[2] == 4 and image[..., 3].min() < image[..., 3].max():
        image = image[..., 3]
    elif image.ndim == 3:
        image = image[..., 2]  # OpenCV keeps red last
    if image.dtype == np.uint16:
        image = image if image.max(initial=0) <= 255 else np.right_shift(image, 8)
    mask = np.ascontiguousarray(image, dtype=np.uint8)
    if mask.max(initial=0) == 1:
        mask = mask * np.uint8(255)
    return mask


def read_bytes(path: Path) -> bytes:
    """A file's content, with errors that name it."""
    return read_input(path, "an image of the capture", _MAX_FILE_BYTES)


def decode(data: bytes, path: Path, mode: int = cv2.IMREAD_UNCHANGED | _UPRIGHT, step: int = 1) -> Image:
    """Pixels of a PNG or JPEG in OpenCV's channel order, 8 bits a channel: (H, W) or (H, W, 3 or 4) u8.

    Arguments:
        step: the reduction that `mode` asks for.
    """
    image = decode_as_stored(data, path, mode, step)
    pixels = np.right_shift(image, 8) if image.dtype == np.uint16 else image
    return pixels.astype(np.uint8, copy=False)


def decode_as_stored(
    data: bytes, path: Path, mode: int = cv2.IMREAD_UNCHANGED | _UPRIGHT, step: int = 1
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """As `decode`, with the 8 or 16 bits a channel that the file has."""
    width, height = check_picture(data, path)
    check_jpeg_data(data, path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error as error:
        raise damaged(path, f"it cannot be decoded ({error.err})") from error
    if image is None or image.shape[:2] != (-(-height // step), -(-width // step)):
        raise damaged(path, "it cannot be decoded")
    if image.dtype not in (np.uint8, np.uint16):
        raise damaged(path, f"its pixels are {image.dtype}")
    pixels: NDArray[Any] = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    return pixels


def check_size(image: Image, width: int, height: int, path: Path) -> Image:
    """The image, if it has the size that its camera was calibrated for."""
    if image.shape[:2] != (height, width):
        raise BadData(
            f"The image has {image.shape[1]} x {image.shape[0]} pixels, its camera {width} x {height}.",
            str(path),
            "Use the calibration that belongs to this image size.",
        )
    return image

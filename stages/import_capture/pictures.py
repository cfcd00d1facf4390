"""Pictures as cameras and phones write them: upright, 8 bits a channel, in colour, with alpha if any."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.input_files import read_input

_Image = NDArray[np.uint8]

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_LIMIT = 1 << 30
_CMYK_CHANNELS = 4
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_picture(path: Path) -> tuple[_Image, _Image | None]:
    """RGB (H, W, 3) u8 and alpha (H, W) u8 if there is any; the EXIF orientation is applied.

    16-bit pictures keep their upper 8 bits, grey ones become three equal channels.

    Raises:
        BadData: a CMYK picture, or one that cannot be decoded.
    """
    data = read_input(path, "a picture", _LIMIT)
    if data.startswith(b"\xff\xd8") and _jpeg_channels(data) == _CMYK_CHANNELS:
        raise BadData(
            "The picture has CMYK colours; how they look depends on a printer.",
            str(path),
            "Convert it to RGB (sRGB).",
        )
    raw = np.frombuffer(data, np.uint8)
    picture = _decoded(raw, cv2.IMREAD_UNCHANGED, path)
    alpha = None
    if picture.ndim == 3 and picture.shape[2] == 4:
        alpha = np.ascontiguousarray(_eight_bits(picture[..., 3]))
        picture = picture[..., :3]
    else:
        picture = _decoded(raw, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH, path)
    return np.ascontiguousarray(_eight_bits(picture)[..., ::-1]), alpha


def read_grey(path: Path) -> _Image:
    """Coverage (H, W) u8 of a mask; its alpha channel where it has one that varies, else its brightness."""
    image, alpha = read_picture(path)
    if alpha is not None and alpha.min() != alpha.max():
        return alpha
    mask = image.max(axis=-1)
    return mask * np.uint8(255) if mask.max() == 1 else mask


def _decoded(raw: NDArray[np.uint8], mode: int, path: Path) -> NDArray:
    try:
        picture = cv2.imdecode(raw, mode)
    except cv2.error as error:
        raise _damaged(path, str(error.err)) from error
    if picture is None:
        raise _damaged(path, "it is of no kind that is known, or cut short")
    return np.asarray(picture)


def _damaged(path: Path, reason: str) -> BadData:
    return BadData(
        f"The picture cannot be decoded: {reason}.",
        str(path),
        "Copy it again, or convert it to PNG or JPEG.",
    )


def _eight_bits(picture: NDArray) -> _Image:
    if picture.dtype == np.uint16:
        return np.right_shift(picture, 8).astype(np.uint8)
    if picture.dtype != np.uint8:
        return np.clip(255 * picture.astype(np.float64), 0, 255).astype(np.uint8)
    return picture


def _jpeg_channels(data: bytes) -> int:
    """Channels that the frame header of a JPEG states; 0 when there is none."""
    position = 2
    while position + 9 < len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
        elif marker in _JPEG_FRAMES:
            return data[position + 9]
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    return 0

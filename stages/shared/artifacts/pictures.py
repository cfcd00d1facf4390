"""PNG, written with the same bytes on every machine that has the same zlib."""

from __future__ import annotations

import struct
import zlib

import numpy as np

_COLOR_TYPES = {1: 0, 3: 2, 4: 6}  # channels to PNG colour type: grey, RGB, RGBA
_UP_FILTER = 2
_LEVEL = 6


def encode_png(picture: np.ndarray) -> bytes:
    """PNG of a picture (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), uint8.

    Every row is stored as its difference to the row above, which suits smooth renders and flat masks alike.
    """
    picture = np.ascontiguousarray(picture)
    if picture.ndim == 2:
        picture = picture[:, :, None]
    shape_fits = picture.ndim == 3 and picture.shape[2] in _COLOR_TYPES and picture.size > 0
    if not shape_fits or picture.dtype != np.uint8:
        raise ValueError(f"a picture is (H, W, 1, 3 or 4) uint8, not {picture.shape} {picture.dtype}")
    height, width, channels = picture.shape
    rows = np.empty((height, 1 + width * channels), np.uint8)
    rows[:, 0] = _UP_FILTER
    flat = picture.reshape(height, width * channels)
    rows[0, 1:] = flat[0]
    rows[1:, 1:] = flat[1:] - flat[:-1]  # modulo 256, as the format has it
    header = struct.pack(">IIBBBBB", width, height, 8, _COLOR_TYPES[channels], 0, 0, 0)
    body = zlib.compress(rows.tobytes(), _LEVEL)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

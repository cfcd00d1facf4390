"""What a PNG or JPEG file says about itself, read before any pixel is decoded."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
MAX_PIXELS = 64_000_000
_PALETTE_TYPE = 3
# Start-of-frame markers; C4, C8 and CC share the range but mean other things.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def check_picture(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height of a whole PNG or JPEG of a bearable size.

    Raises:
        BadData: another format, cut short, a wrong checksum, more than 64 million pixels.
    """
    if data.startswith(PNG_MAGIC):
        width, height = _check_png(data, path)
    elif data.startswith(JPEG_MAGIC):
        width, height = _check_jpeg(data, path)
    else:
        raise BadData(
            "This is neither a PNG nor a JPEG image.",
            str(path),
            "Convert it to PNG (masks and labels) or JPEG.",
        )
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise BadData(
            f"The image has {width} x {height} pixels; at most {MAX_PIXELS // 10**6} million are read.",
            str(path),
            "Scale the capture down, calibration included.",
        )
    return width, height


def palette_as_grey(data: bytes, path: Path) -> tuple[bytes, NDArray[np.uint8] | None]:
    """The palette (n, 3) u8 RGB of a PNG, and the same PNG with its indices as grey values.

    OpenCV hands out a palette image in colours only; declaring the indices to be grey keeps them. Indices of
    less than 8 bits are spread over 0..255 by the decoder, so they are refused: label palettes have 8.
    An image without a palette comes back as it is, with None.
    """
    if not data.startswith(PNG_MAGIC):
        return data, None
    pieces, palette = [PNG_MAGIC], None
    for kind, body in _chunks(data, path):
        if kind == b"IHDR":
            if body[9] != _PALETTE_TYPE:
                return data, None
            if body[8] != 8:
                raise BadData(
                    f"A palette image of {body[8]} bits a pixel.",
                    str(path),
                    "Save label images with 8 bits a pixel.",
                )
            body = body[:9] + b"\x00" + body[10:]
        elif kind == b"PLTE":
            palette = np.frombuffer(body[: len(body) // 3 * 3], np.uint8).reshape(-1, 3)[:256]
            continue
        elif kind not in (b"IDAT", b"IEND"):
            continue
        pieces.append(_chunk(kind, body))
    if palette is None:
        raise damaged(path, "its palette is missing")
    return b"".join(pieces), palette


def damaged(path: Path, reason: str) -> BadData:
    """The error for a file that cannot be read whole."""
    return BadData(
        f"The image is damaged: {reason}.", str(path), "Copy the file again, or leave this frame out."
    )


def _check_png(data: bytes, path: Path) -> tuple[int, int]:
    kinds: list[bytes] = []
    size = (0, 0)
    for kind, body in _chunks(data, path):
        if not kinds:
            if kind != b"IHDR" or len(body) != 13:
                raise damaged(path, "its header is missing")
            size = struct.unpack(">II", body[:8])
        kinds.append(kind)
    if b"IDAT" not in kinds or kinds[-1] != b"IEND":
        raise damaged(path, "it ends early (cut short while it was written or copied)")
    return size


def _chunks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each piece of a PNG up to its end, checksums compared."""
    position = len(PNG_MAGIC)
    while position < len(data):
        if position + 12 > len(data):
            raise damaged(path, f"it ends early, at byte {len(data)}")
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            raise damaged(path, f"it ends early, at byte {len(data)}")
        body = data[position + 8 : end - 4]
        if zlib.crc32(data[position + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise damaged(path, f"a checksum is wrong near byte {position}")
        yield kind, body
        if kind == b"IEND":
            return
        position = end


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _check_jpeg(data: bytes, path: Path) -> tuple[int, int]:
    if b"\xff\xd9" not in data[-4096:]:
        raise damaged(path, "it ends early (no end marker)")
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            break
        marker = data[position + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            position += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_FRAMES and position + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        if marker in (0xDA, 0xD9):
            break
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]
    raise damaged(path, "no frame header was found")

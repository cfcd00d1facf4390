"""What a PNG or JPEG file says about itself, read before any pixel is decoded."""

from __future__ import annotations

import re
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
_EXIF = b"Exif\x00\x00"
_ORIENTATION_TAG = 0x0112
_whole_files: set[tuple[str, int, int]] = set()  # JPEG files of this process that were found whole
# Start-of-frame markers; C4, C8 and CC share the range but mean other things.
_MARKER = re.compile(rb"\xff[^\x00\x01\xff\xd0-\xd8]")  # of a segment, also after compressed data
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def check_picture(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height of a whole PNG or JPEG of a bearable size.

    Raises:
        BadData: another format, cut short, a wrong checksum, an EXIF orientation other than upright, more
            than 64 million pixels.
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
    orientation = _orientation(data, path)
    if orientation != 1:
        raise BadData(
            f"The image is stored turned or mirrored (EXIF orientation {orientation}). Programs disagree on "
            "showing it upright, so that calibration and masks may mean either.",
            str(path),
            "Save the pixels upright and without the tag, with masks and calibration alike, for example with "
            "mogrify -auto-orient.",
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


def check_jpeg_data(data: bytes, path: Path) -> None:
    """Refuse a JPEG whose compressed data is damaged or ends early though its end marker is there.

    The decoder of OpenCV fills what is missing with grey and prints a warning that a program cannot see.
    The one of FFmpeg can be told to fail. Other files are passed over, and a file is looked at once.
    """
    if not data.startswith(JPEG_MAGIC):
        return
    key = str(path), len(data), zlib.crc32(data)
    if key in _whole_files:
        return
    if _lacks_scans(data):
        raise damaged(path, "scans of its progressive data are missing")
    import av  # loads FFmpeg

    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode"}
    try:
        decoder.decode(av.Packet(data))
    except av.error.InvalidDataError as error:
        raise damaged(path, "its compressed data is broken or ends early") from error
    except av.error.FFmpegError:
        pass  # a kind of JPEG that FFmpeg does not know; OpenCV decides
    _whole_files.add(key)


def bits_of_png(data: bytes) -> int:
    """Bits per channel that the header of a PNG states; 8 for other files."""
    return data[24] if data.startswith(PNG_MAGIC) and len(data) > 24 else 8


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
    for marker, segment in _segments(data):
        if marker in _JPEG_FRAMES and len(segment) >= 5:
            height, width = struct.unpack_from(">HH", segment, 1)
            return width, height
    raise damaged(path, "no frame header was found")


def _orientation(data: bytes, path: Path) -> int:
    """EXIF orientation of a PNG or JPEG, 1 (upright) where none is stated."""
    if data.startswith(PNG_MAGIC):
        return next((_exif_orientation(body) for kind, body in _chunks(data, path) if kind == b"eXIf"), 1)
    for marker, segment in _segments(data):
        if marker == 0xE1 and segment.startswith(_EXIF):
            return _exif_orientation(segment[len(_EXIF) :])
    return 1


def _segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Marker and content of the segments of a JPEG up to its image data."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:
            position += 1 if marker == 0xFF else 2
            continue
        if marker in (0xDA, 0xD9):
            return
        length = struct.unpack_from(">H", data, position + 2)[0]
        yield marker, data[position + 4 : position + 2 + length]
        position += 2 + length


def _lacks_scans(data: bytes) -> bool:
    """Whether coefficients of a progressive JPEG are not there down to their last bit.

    Such a file was cut between two of its scans, and decoders show what there is: a blurred picture. Each
    scan header names components, a band of coefficients and the lowest bit it brings (ITU-T T.81, B.2.3).
    """
    bits: dict[int, list[int]] = {}  # component to the lowest bit there is of each coefficient
    position = 2
    while match := _MARKER.search(data, position):
        marker, position = match[0][1], match.end()
        if marker == 0xD9:
            break
        if position + 2 > len(data):
            break
        length = struct.unpack_from(">H", data, position)[0]
        segment = data[position + 2 : position + length]
        position += length
        if marker == 0xC2 and len(segment) >= 6:
            bits = {component: [99] * 64 for component in segment[6 : 6 + 3 * segment[5] : 3]}
        elif marker in _JPEG_FRAMES:
            return False  # another kind of JPEG
        elif marker == 0xDA and bits and segment and len(segment) >= 4 + 2 * segment[0]:
            first, last, low = segment[1 + 2 * segment[0] :][:3]
            for component in segment[1 : 1 + 2 * segment[0] : 2]:
                if component in bits and first <= last < 64:
                    bits[component][first : last + 1] = [low & 15] * (last + 1 - first)
    return any(bit for lowest in bits.values() for bit in lowest)


def _exif_orientation(exif: bytes) -> int:
    """The orientation in a TIFF header with its first directory; 1 where it cannot be read."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    if order is None or len(exif) < 8:
        return 1
    (start,) = struct.unpack_from(order + "I", exif, 4)
    if start + 2 > len(exif):
        return 1
    (count,) = struct.unpack_from(order + "H", exif, start)
    for entry in range(min(count, 512)):
        place = start + 2 + 12 * entry
        if place + 12 > len(exif):
            break
        tag, kind = struct.unpack_from(order + "HH", exif, place)
        if tag == _ORIENTATION_TAG:
            value = struct.unpack_from(order + ("H" if kind == 3 else "I"), exif, place + 8)[0]
            return int(value) if 1 <= value <= 8 else 1
    return 1

"""Label images: read in the three ways they are stored, and painted for people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.image_files import PNG_MAGIC, bits_of_png, palette_as_grey
from stages.shared.capture.images import decode, decode_as_stored, read_bytes
from stages.shared.errors import BadData
from stages.shared.layers import LABEL_COLORS, LABELS, label_legend

_UNKNOWN = 254
_Image = NDArray[np.uint8]


def read_labels(path: Path) -> _Image:
    """Label ids (H, W) u8 of a PNG: single-channel ids, a palette, or the colours of 4D-DRESS.

    A palette image is read by its colours when all that it uses are known, and by its indices otherwise: some
    programs sort a palette when they save it, which keeps the colours and changes the indices.

    Raises:
        BadData: damaged file, or ids or colours that are no label (named).
    """
    data = read_bytes(path)
    if bits_of_png(data) < 8 or not data.startswith(PNG_MAGIC):
        # Decoders spread less than 8 bits over 0 to 255, and JPEG changes values: ids would not be ids.
        raise BadData(
            f"A label image of {bits_of_png(data)} bits a pixel."
            if data.startswith(PNG_MAGIC)
            else "A label image that is not PNG.",
            str(path),
            "Save label images as PNG with 8 or 16 bits a pixel.",
        )
    grey, palette = palette_as_grey(data, path)
    if palette is None:
        image = _eight_bits(decode_as_stored(data, path), path)
        ids = _ids_of_colors(image) if image.ndim == 3 else image
    else:
        indices = decode(grey, path)
        colors = np.full((256, 3), 0, np.uint8)
        colors[: len(palette)] = palette
        ids = _ids_of_colors(colors[None, :, ::-1])[0][indices]
        if (ids == _UNKNOWN).any():
            ids = indices
    known = np.isin(np.arange(256), list(LABELS))
    counts = np.bincount(ids.reshape(-1), minlength=256)
    wrong = np.flatnonzero((counts > 0) & ~known)
    if len(wrong):
        if palette is None and image.ndim == 3:
            found = "colours (RGB) " + ", ".join(str(color) for color in _unknown_colors(image, ids))
        else:
            found = "ids " + ", ".join(str(value) for value in wrong[:8])
        raise BadData(
            f"The label image uses {found}, which mean nothing here.",
            str(path),
            f"Use ids {label_legend()}, or the colours of 4D-DRESS.",
        )
    return ids


def _eight_bits(image: NDArray[np.uint8] | NDArray[np.uint16], path: Path) -> _Image:
    """Ids and colours of a 16-bit image: ids as they are, colours scaled where they are multiples of 257."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    largest = int(image.max(initial=0))
    if largest > 255 and (image.ndim == 2 or (image % 257).any()):
        raise BadData(
            f"The label image uses ids up to {largest}, which mean nothing here.",
            str(path),
            f"Use ids {label_legend()}, or the colours of 4D-DRESS.",
        )
    return (image // 257 if largest > 255 else image).astype(np.uint8)


def _ids_of_colors(bgr: _Image) -> _Image:
    """(H, W) ids of a (H, W, 3+) image; `_UNKNOWN` where the colour is no label's."""
    packed = (bgr[..., 2].astype(np.int32) << 16) | (bgr[..., 1].astype(np.int32) << 8) | bgr[..., 0]
    keys = np.array([(r << 16) | (g << 8) | b for r, g, b in LABEL_COLORS.values()])
    values = np.array(list(LABEL_COLORS), np.uint8)
    order = np.argsort(keys)
    keys, values = keys[order], values[order]
    place = np.clip(np.searchsorted(keys, packed), 0, len(keys) - 1)
    return np.where(keys[place] == packed, values[place], np.uint8(_UNKNOWN)).astype(np.uint8)


def _unknown_colors(bgr: _Image, ids: _Image) -> list[tuple[int, ...]]:
    colors = np.unique(bgr[ids == _UNKNOWN][:, 2::-1][:10_000], axis=0)[:4]
    return [tuple(int(value) for value in color) for color in colors]


def label_picture(ids: _Image) -> _Image:
    """RGB (..., 3) u8 picture of label ids (...,)."""
    colors = np.zeros((256, 3), np.uint8)
    for value, color in LABEL_COLORS.items():
        colors[value] = color
    return colors[ids]

"""Contact sheets: pictures in rows of equal cells."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
_PAPER, _INK, _CAPTION = 245, 40, 22


def contact_sheet(pictures: Sequence[Picture], columns: int, captions: Sequence[str] = ()) -> Picture:
    """Pictures (h, w, 3) u8 of any size side by side, `columns` to a row, in cells of the largest size.

    Arguments:
        captions: one per picture, or none at all.
    """
    if not pictures:
        return np.full((16, 16, 3), _PAPER, np.uint8)
    height = max(picture.shape[0] for picture in pictures)
    width = max(picture.shape[1] for picture in pictures)
    texts = list(captions) or [""] * len(pictures)
    strip = _CAPTION if captions else 0
    cells = [_cell(p, text, height, width, strip) for p, text in zip(pictures, texts, strict=True)]
    cells += [np.full_like(cells[0], _PAPER)] * (-len(cells) % columns)
    rows = [np.hstack(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    return np.vstack(rows)


def shrunk(picture: Picture, largest_side: int) -> Picture:
    """The picture, made smaller if a side is longer than `largest_side` pixels."""
    factor = largest_side / max(picture.shape[:2])
    if factor >= 1:
        return picture
    size = (max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def chosen(count: int, most: int) -> list[int]:
    """At most `most` indices out of `count`, evenly spread, first and last among them."""
    if count <= most:
        return list(range(count))
    return sorted({round(index) for index in np.linspace(0, count - 1, most)})


def _cell(picture: Picture, text: str, height: int, width: int, strip: int) -> Picture:
    cell = np.full((height + strip, width, 3), _PAPER, np.uint8)
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    cell[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    if text:
        place = (6, height + strip - 7)
        cv2.putText(cell, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (_INK,) * 3, 1, cv2.LINE_AA)
    return cell

"""Truth and methods side by side: a column each, a row per view, cropped to the subject, with its scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.evaluate.methods import Method, TrainedMethod
from stages.evaluate.score_table import subject_crop
from stages.evaluate.views import FrameViews
from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.metrics.picture import psnr
from stages.shared.metrics.ssim import ssim_in_box
from stages.shared.outfit.outfit import Outfit

Picture = NDArray[np.uint8]
_HEIGHT, _WIDEST = 420, 440  # px, of a crop as drawn
_GAP, _STRIP = 10, 40
_PAPER, _INK, _LETTERS = 255, 40, 0.8
Row = tuple[str, list[Picture], list[str]]  # which view, its pictures, what is written below each


def compare_outfits(
    splits: Mapping[str, Sequence[FrameViews]], outfits: Mapping[str, Outfit], pictures: int = 2
) -> Picture:
    """(H, W, 3) u8: truth and every outfit, for `pictures` frames of every split.

    The first frame of a take is not shown where there are others: often it is the template's own.
    """
    methods: dict[str, Method] = {name: TrainedMethod(outfit) for name, outfit in outfits.items()}
    rows = [
        _row(split, frame, frame.cameras[index % len(frame.cameras)], methods)
        for split, frames in splits.items()
        for index, frame in enumerate(shown_frames(frames, pictures))
    ]
    return comparison_sheet(["truth", *methods], rows)


def comparison_sheet(columns: Sequence[str], rows: Sequence[Row]) -> Picture:
    """Names of the columns above, then for each row its name, its pictures and what is written below them."""
    widths = [max(row[1][index].shape[1] for row in rows) + _GAP for index in range(len(columns))]
    widths = [max(width, 200) for width in widths]
    parts = [_strip(columns, widths)]
    for name, pictures, below in rows:
        title = np.full((_STRIP, sum(widths), 3), _PAPER, np.uint8)
        _letters(title, name, _GAP, _fitting(name, sum(widths)))
        height = max(picture.shape[0] for picture in pictures)
        cells = [_cell(picture, width, height) for picture, width in zip(pictures, widths, strict=True)]
        parts += [title, np.hstack(cells), _strip(below, widths)]
    return np.vstack(parts)


def shown_frames(frames: Sequence[FrameViews], count: int) -> list[FrameViews]:
    """`count` frames, from the middles of as many parts of a split; the first ones of takes are left out."""
    later = [frame for frame in frames if not frame.first] or list(frames)
    if len(later) <= count:
        return later
    return [later[int((index + 0.5) * len(later) / count)] for index in range(count)]


def _row(split: str, frame: FrameViews, camera: str, methods: Mapping[str, Method]) -> Row:
    truth, mask = frame.take.image(camera, frame.frame), frame.take.mask(camera, frame.frame)
    cut, inside = subject_crop(mask), mask > MASK_THRESHOLD
    pictures, below = [_drawn(truth[cut])], [""]
    for method in methods.values():
        method.pose(frame)
        picture = method.render(frame.take.camera(camera))[0]
        pictures.append(_drawn(picture[cut]))
        scores = psnr(picture, truth, inside), ssim_in_box(picture, truth, inside)
        below.append("" if None in scores else "{:.1f} dB, {:.3f}".format(*scores))
    name = f"{split.replace('_', ' ')}: {frame.take.name}, frame {frame.frame}, {camera}"
    return name, pictures, below


def _drawn(picture: Picture) -> Picture:
    """The crop at the height that all rows have, or lower where it would be too wide."""
    factor = min(_HEIGHT / picture.shape[0], _WIDEST / picture.shape[1])
    size = max(1, round(factor * picture.shape[1])), max(1, round(factor * picture.shape[0]))
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=way), dtype=np.uint8)


def _cell(picture: Picture, width: int, height: int) -> Picture:
    cell = np.full((height, width, 3), _PAPER, np.uint8)
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    cell[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return cell


def _strip(texts: Sequence[str], widths: Sequence[int]) -> Picture:
    """A text in the middle of each column, all in letters of one size, such that they fit."""
    strip = np.full((_STRIP, sum(widths), 3), _PAPER, np.uint8)
    scale = min(_fitting(text, width) for text, width in zip(texts, widths, strict=True))
    start = 0
    for text, width in zip(texts, widths, strict=True):
        _letters(strip, text, start + (width - _length(text, scale)) // 2, scale)
        start += width
    return strip


def _fitting(text: str, width: int) -> float:
    """Scale of the letters with which a text fits."""
    return min(_LETTERS, _LETTERS * (width - _GAP) / max(1, _length(text, _LETTERS)))


def _length(text: str, scale: float) -> int:
    return int(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)[0][0])


def _letters(strip: Picture, text: str, start: int, scale: float) -> None:
    place, thickness = (start, _STRIP - 12), 2 if scale > 0.5 else 1
    cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (_INK,) * 3, thickness, cv2.LINE_AA)

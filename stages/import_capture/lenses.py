"""The calibrated lens of each recording, in the size that its pictures really have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.shared.calibration.model import LensCamera
from stages.shared.errors import BadData

_BLACK, _EVEN = 40.0, 12.0  # grey levels: brightest mean of a bar, and its largest spread
_TURNED = 0.01


def fitted_lens(lens: LensCamera, image: NDArray[np.uint8]) -> tuple[LensCamera, str | None]:
    """The lens for pictures of this size, and what was assumed.

    Pictures may be smaller or larger than the calibrated ones, and may have black bars above and below.

    Arguments:
        image: (H, W, 3) u8, the first picture.

    Raises:
        BadData: pictures of another shape, or turned by a quarter.
    """
    height, width = image.shape[:2]
    if lens.size is None:
        return replace(lens, size=(width, height)), None
    if lens.size == (width, height):
        return lens, None
    if abs(lens.size[1] / lens.size[0] * height / width - 1) < _TURNED and width != height:
        raise BadData(
            f"The picture has {width} x {height} pixels, its calibration {lens.size[0]} x {lens.size[1]}: "
            "it is turned by a quarter.",
            f"camera {lens.name}",
            "Give pictures in the orientation in which they were calibrated.",
        )
    bars = round((height - lens.size[1] * width / lens.size[0]) / 2)
    if bars > 0 and _is_bar(image[:bars]) and _is_bar(image[-bars:]):
        resized = lens.resized(width, height, bars)
        return resized, f"{lens.name}: scaled to {width} pixels, with black bars of {bars} above and below"
    resized = lens.resized(width, height)
    return resized, f"{lens.name}: scaled from {lens.size[0]} x {lens.size[1]} to {width} x {height}"


def _is_bar(rows: NDArray[np.uint8]) -> bool:
    inner = rows[1:-1] if len(rows) > 2 else rows  # compression blurs the bar's edge
    return float(inner.mean()) < _BLACK and float(inner.mean(axis=(0, 2)).std()) < _EVEN

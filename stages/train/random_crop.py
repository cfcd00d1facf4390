"""Random crops of large pictures: the part of a view that a step sees at full resolution.

Half of the probability of a crop follows how much of the person it shows. The other half follows how much of
the boundaries of person and layers it shows. Crops of background alone are rare, and garment edges are seen
more often than plain cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Box

SMALLEST = 32  # px; SSIM's window and optical flow need some room
_STEPS = 8  # positions per side of a crop


@dataclass(frozen=True)
class RandomCrop:
    """A square crop: `side` px, and the `key` that seeds its position."""

    side: int
    key: tuple[int, ...]

    def box(self, layer: NDArray[np.uint8], background: int) -> Box:
        """The crop of a view: left, top, right, bottom. It is the whole view where that is smaller.

        Arguments:
            layer: (H, W) ids of layers, `background` where there is none.
        """
        height, width = layer.shape
        rows, columns = _positions(height, self.side), _positions(width, self.side)
        inside = (layer != background).astype(np.uint8)
        shares = [_crop_sums(part, rows, columns, self.side) for part in (inside, boundaries(layer))]
        weights = sum(share / total for share in shares if (total := share.sum()) > 0)
        chances = np.asarray(weights, dtype=np.float64).reshape(-1)
        if not chances.any():
            chances = np.ones(len(rows) * len(columns))
        drawn = np.random.default_rng(list(self.key)).random() * chances.sum()
        chosen = min(int(np.searchsorted(np.cumsum(chances), drawn, side="right")), len(chances) - 1)
        top, left = int(rows[chosen // len(columns)]), int(columns[chosen % len(columns)])
        return left, top, min(left + self.side, width), min(top + self.side, height)


def boundaries(layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) 1 where a pixel and the one to the right or below belong to different layers."""
    boundary = np.zeros(layer.shape, np.uint8)
    boundary[:, :-1] |= layer[:, :-1] != layer[:, 1:]
    boundary[:-1] |= layer[:-1] != layer[1:]
    return boundary


def _positions(length: int, side: int) -> NDArray[np.int64]:
    """Where crops may start on one axis: every `side`/8 px, and at the last position that fits."""
    last = max(length - side, 0)
    return np.unique(np.append(np.arange(0, last, max(side // _STEPS, 1)), last))


def _crop_sums(
    part: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], side: int
) -> NDArray[np.float64]:
    """(R, C) sums of a picture (H, W) over the crops that start at these rows and columns."""
    table = cv2.integral(part, sdepth=cv2.CV_64F)
    low, high = np.minimum(rows + side, part.shape[0]), np.minimum(columns + side, part.shape[1])
    ends, begins = table[np.ix_(low, high)], table[np.ix_(rows, columns)]
    return np.asarray(ends - table[np.ix_(rows, high)] - table[np.ix_(low, columns)] + begins)

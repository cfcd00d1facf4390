"""Sharpness relative to the truth: shows blur, which PSNR can reward."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.metrics.psnr import Picture, check_pictures

_RIM = 2  # pixels left out at the edge of the mask, whose contrast is the background's


def sharpness(prediction: Picture, truth: Picture, inside: NDArray[np.bool_]) -> float | None:
    """Gradient energy of the prediction over that of the truth, inside the foreground.

    Energy is the mean squared central difference (both axes, three channels) over the pixels `inside` (H, W)
    that are at least 2 px from its edge. 1: as sharp as the truth; below 1: blurred. None without such pixels
    or without any gradient in the truth.
    """
    check_pictures(prediction, truth)
    size = 2 * _RIM + 1
    core = cv2.erode(inside.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=0) > 0
    reference = _energy(truth, core)
    return _energy(prediction, core) / reference if reference > 0 else None


def _energy(picture: Picture, core: NDArray[np.bool_]) -> float:
    """Mean over the core pixels of |∂x|² + |∂y|², in (grey levels per pixel)²; 0 without pixels."""
    if not core.any():
        return 0.0
    values = picture.astype(np.float32)
    across = (np.roll(values, -1, axis=1) - np.roll(values, 1, axis=1))[core] / 2
    down = (np.roll(values, -1, axis=0) - np.roll(values, 1, axis=0))[core] / 2
    return float(np.mean(np.square(across) + np.square(down), dtype=np.float64))

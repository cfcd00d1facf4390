"""Structural similarity (Wang et al. 2004) of 8-bit pictures, with a Gaussian or a uniform window."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.metrics.psnr import PEAK, Picture, check_pictures

WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2


def ssim(prediction: Picture, truth: Picture, window: str = "gaussian") -> float | None:
    """Mean SSIM over the pixels whose 11 × 11 window lies inside the picture, and over the channels.

    Arguments:
        prediction, truth: (H, W, 3) u8 sRGB.
        window: "gaussian" (sigma 1.5, plain covariance) or "uniform" (sample covariance, as the published
            avatars were scored).

    Returns:
        −1..1, or None for a picture that is smaller than the window.
    """
    check_pictures(prediction, truth)
    if min(truth.shape[:2]) < WINDOW:
        return None
    x, y = prediction.astype(np.float64), truth.astype(np.float64)
    mean_x, mean_y = _smooth(x, window), _smooth(y, window)
    count = WINDOW * WINDOW
    factor = count / (count - 1) if window == "uniform" else 1.0
    variance_x = factor * (_smooth(x * x, window) - mean_x * mean_x)
    variance_y = factor * (_smooth(y * y, window) - mean_y * mean_y)
    covariance = factor * (_smooth(x * y, window) - mean_x * mean_y)
    above = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    below = (mean_x * mean_x + mean_y * mean_y + _C1) * (variance_x + variance_y + _C2)
    margin = WINDOW // 2
    return float((above / below)[margin:-margin, margin:-margin].mean())


def ssim_in_box(prediction: Picture, truth: Picture, inside: NDArray[np.bool_]) -> float | None:
    """Gaussian-window SSIM of the bounding box of the pixels `inside` (H, W); None when there are none."""
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return ssim(prediction[box], truth[box])


def _smooth(values: NDArray[np.float64], window: str) -> NDArray[np.float64]:
    """Weighted mean over the window around every pixel of (H, W, 3)."""
    if window == "uniform":
        weights = np.full(WINDOW, 1 / WINDOW)
    else:
        weights = np.exp(-0.5 * (np.arange(WINDOW) - WINDOW // 2) ** 2 / _SIGMA**2)
        weights /= weights.sum()
    smooth = cv2.sepFilter2D(values, cv2.CV_64F, weights, weights, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth, dtype=np.float64)

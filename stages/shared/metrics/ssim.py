"""Structural similarity of 8-bit pictures: SSIM (Wang et al. 2004) and MS-SSIM (Wang et al. 2003)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.metrics.picture import PEAK, Picture, check_pictures

WINDOW = 11
_SIGMA = 1.5
_C1, _C2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # of MS-SSIM, from full size to a sixteenth


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
    luminance, structure = _factors(prediction.astype(np.float64), truth.astype(np.float64), window)
    return float((luminance * structure).mean())


def ms_ssim(prediction: Picture, truth: Picture) -> float | None:
    """Mean over the channels of MS-SSIM: contrast and structure on five scales, luminance on the coarsest.

    Each scale halves the size by means of 2 × 2 pixels. A scale contributes the mean of its factor over
    the pixels whose 11 × 11 Gaussian window lies inside the picture, to the power of its weight. Negative
    means count as 0. An odd last row or column is left out when the size is halved.

    Arguments:
        prediction, truth: (H, W, 3) u8 sRGB.

    Returns:
        0..1, or None for a picture with a side below 176 px, whose coarsest scale is smaller than the window.
    """
    check_pictures(prediction, truth)
    if min(truth.shape[:2]) < WINDOW << (len(_SCALE_WEIGHTS) - 1):
        return None
    x, y = prediction.astype(np.float64), truth.astype(np.float64)
    product = np.ones(3)
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        if scale:
            x, y = _halved(x), _halved(y)
        luminance, structure = _factors(x, y, "gaussian")
        factor = luminance * structure if scale == len(_SCALE_WEIGHTS) - 1 else structure
        product *= factor.mean(axis=(0, 1)).clip(min=0.0) ** weight
    return float(product.mean())


def ssim_in_box(prediction: Picture, truth: Picture, inside: NDArray[np.bool_]) -> float | None:
    """Gaussian-window SSIM of the bounding box of the pixels `inside` (H, W); None when there are none."""
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return None
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return ssim(prediction[box], truth[box])


def _factors(
    x: NDArray[np.float64], y: NDArray[np.float64], window: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Luminance, and contrast times structure, of the pixels whose window lies inside (H, W, 3) pictures."""
    mean_x, mean_y = _smooth(x, window), _smooth(y, window)
    count = WINDOW * WINDOW
    unbiased = count / (count - 1) if window == "uniform" else 1.0
    variance_x = unbiased * (_smooth(x * x, window) - mean_x * mean_x)
    variance_y = unbiased * (_smooth(y * y, window) - mean_y * mean_y)
    covariance = unbiased * (_smooth(x * y, window) - mean_x * mean_y)
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x * mean_x + mean_y * mean_y + _C1)
    structure = (2 * covariance + _C2) / (variance_x + variance_y + _C2)
    inner = slice(WINDOW // 2, -(WINDOW // 2))
    return luminance[inner, inner], structure[inner, inner]


def _halved(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) to (H/2, W/2, 3): means of 2 × 2 pixels."""
    height, width = (side // 2 * 2 for side in picture.shape[:2])
    blocks = picture[:height, :width].reshape(height // 2, 2, width // 2, 2, 3)
    return np.asarray(blocks.mean(axis=(1, 3)))


def _smooth(values: NDArray[np.float64], window: str) -> NDArray[np.float64]:
    """Weighted mean over the window around every pixel of (H, W, 3)."""
    if window == "uniform":
        weights = np.full(WINDOW, 1 / WINDOW)
    else:
        weights = np.exp(-0.5 * (np.arange(WINDOW) - WINDOW // 2) ** 2 / _SIGMA**2)
        weights /= weights.sum()
    smooth = cv2.sepFilter2D(values, cv2.CV_64F, weights, weights, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth, dtype=np.float64)

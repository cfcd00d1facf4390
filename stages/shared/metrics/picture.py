"""Scores of 8-bit pictures that need no window: PSNR, sharpness, overlap of masks and of label images."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData
from stages.shared.layers import GARMENT_LABELS

Picture = NDArray[np.uint8]
PEAK = 255.0
_RIM = 2  # pixels left out at the edge of the mask, whose contrast is the background's


def psnr(prediction: Picture, truth: Picture, inside: NDArray[np.bool_] | None = None) -> float | None:
    """PSNR in dB: 10 log10(255² / mean squared difference of the sRGB values).

    Arguments:
        prediction, truth: (H, W, 3) u8.
        inside: (H, W) pixels that count; None for all.

    Returns:
        dB; infinity for equal pictures, None where no pixel counts.

    Raises:
        BadData: shapes or types that do not agree.
    """
    check_pictures(prediction, truth)
    difference = prediction.astype(np.int32) - truth.astype(np.int32)
    if inside is not None:
        difference = difference[inside]
    if not difference.size:
        return None
    error = float(np.mean(np.square(difference), dtype=np.float64))
    return math.inf if error == 0 else 10 * math.log10(PEAK**2 / error)


def check_pictures(prediction: Picture, truth: Picture) -> None:
    """Raise BadData unless both are 8-bit colour pictures of one size."""
    for name, picture in (("prediction", prediction), ("truth", truth)):
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise BadData(
                f"The {name} is {picture.dtype} {picture.shape}, not an 8-bit colour picture.",
                name,
                "Give (H, W, 3) u8 sRGB.",
            )
    if prediction.shape != truth.shape:
        raise BadData(
            f"The prediction has {prediction.shape[1]} x {prediction.shape[0]} pixels, the truth "
            f"{truth.shape[1]} x {truth.shape[0]}.",
            "prediction, truth",
            "Render with the cameras of the truth.",
        )


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


def iou(prediction: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float | None:
    """Intersection over union of two sets of pixels (H, W); None when both are empty."""
    union = int(np.logical_or(prediction, truth).sum())
    return int(np.logical_and(prediction, truth).sum()) / union if union else None


def segmentation_scores(
    prediction: NDArray[np.uint8], truth: NDArray[np.uint8], classes: Sequence[int] = GARMENT_LABELS
) -> dict[str, float | None]:
    """`miou`, `recall` and `f1` of one label picture (Gaussian Wardrobe, table of the ablation).

    IoU is averaged over the classes that the truth or the prediction shows; recall and precision count the
    right pixels of all classes together; F1 is their harmonic mean. None where nothing can be counted.

    Arguments:
        prediction, truth: (H, W) u8 label ids, 255 where there is nothing.
        classes: ids that count.
    """
    shown = [label for label in classes if (truth == label).any() or (prediction == label).any()]
    overlaps = [iou(prediction == label, truth == label) for label in shown]
    known = [value for value in overlaps if value is not None]
    right = sum(int(((prediction == label) & (truth == label)).sum()) for label in shown)
    actual = sum(int((truth == label).sum()) for label in shown)
    predicted = sum(int((prediction == label).sum()) for label in shown)
    return {
        "miou": float(np.mean(known)) if known else None,
        "recall": right / actual if actual else None,
        "f1": 2 * right / (actual + predicted) if actual + predicted else None,
    }

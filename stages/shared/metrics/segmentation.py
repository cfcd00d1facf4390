"""Overlap of masks, and scores of a label image over its garment classes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.shared.layers import GARMENT_LABELS


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

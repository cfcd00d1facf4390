"""How well two silhouettes agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def iou(prediction: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float | None:
    """Intersection over union of two sets of pixels (H, W); None when both are empty."""
    union = int(np.logical_or(prediction, truth).sum())
    return int(np.logical_and(prediction, truth).sum()) / union if union else None

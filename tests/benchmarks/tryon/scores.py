"""Scores of one view of a try-on: the whole person, and the region of one garment by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.layers import BODY_LABELS, GARMENT_LABELS, SKIN
from stages.shared.metrics.picture import iou, psnr, segmentation_scores
from stages.shared.metrics.scores import Scores, ViewPair
from stages.shared.metrics.ssim import ssim_in_box

NAMES = (
    "region_iou",
    "region_ssim",
    "region_psnr",
    "miou",
    "psnr_foreground",
    "ssim_foreground",
    "iou",
    "skin_through",
    "skin_psnr",
)
_SMALLEST_REGION = 50  # pixels; smaller regions say nothing


def tryon_scores(view: ViewPair, region: int) -> Scores:
    """Scores of a view by name; None where there is nothing to score.

    - `region_iou`: predicted against true pixels of the label `region`. `region_psnr`: over the true ones.
      `region_ssim`: Gaussian window, in their box, everything else grey in both pictures.
    - `skin_through`: of a thousand pixels where the truth shows a garment, those that show the body.
    - `skin_psnr`: over the true pixels of skin.
    - `psnr_foreground`, `ssim_foreground`, `iou`, `miou`: as `gw evaluate`.
    """
    assert view.truth_labels is not None and view.prediction_labels is not None
    inside = view.mask > MASK_THRESHOLD
    true, shown = view.truth_labels == region, view.prediction_labels == region
    scores: Scores = dict.fromkeys(NAMES)
    if true.sum() >= _SMALLEST_REGION:
        scores["region_iou"] = iou(shown, true)
        scores["region_psnr"] = psnr(view.prediction, view.truth, true)
        scores["region_ssim"] = ssim_in_box(_only(view.prediction, shown), _only(view.truth, true), true)
    garments = np.isin(view.truth_labels, GARMENT_LABELS)
    if garments.sum() >= _SMALLEST_REGION:
        scores["skin_through"] = 1000 * float(np.isin(view.prediction_labels[garments], BODY_LABELS).mean())
    skin = inside & (view.truth_labels == SKIN)
    if skin.sum() >= _SMALLEST_REGION:
        scores["skin_psnr"] = psnr(view.prediction, view.truth, skin)
    scores["miou"] = segmentation_scores(view.prediction_labels, view.truth_labels)["miou"]
    scores["psnr_foreground"] = psnr(view.prediction, view.truth, inside)
    scores["ssim_foreground"] = ssim_in_box(view.prediction, view.truth, inside)
    scores["iou"] = iou(view.alpha > 0.5, inside)
    return scores


def means(rows: list[dict[str, Any]]) -> Scores:
    """Mean of each score over the views that have it."""
    found: Scores = {}
    for name in NAMES:
        values = [float(row[name]) for row in rows if row[name] is not None and np.isfinite(row[name])]
        found[name] = float(np.mean(values)) if values else None
    return found


def _only(picture: NDArray[np.uint8], member: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(member[..., None], picture, np.uint8(128))

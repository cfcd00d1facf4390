"""All scores of one view, and their means over views."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.layers import REGIONS
from stages.shared.losses.perceptual import Perceptual, mask_box, square_crop
from stages.shared.metrics.flip import flip
from stages.shared.metrics.picture import Picture, iou, psnr, segmentation_scores, sharpness
from stages.shared.metrics.ssim import ms_ssim, ssim, ssim_in_box

Scores = dict[str, float | None]
Labels = NDArray[np.uint8]
_LPIPS_SIDE, _LPIPS_MARGIN = 512, 50  # pixels, as published avatars are scored
_SMALLEST_REGION = 50  # pixels; smaller regions say nothing

NAMES = (
    "psnr_foreground",
    "ssim_foreground",
    "psnr",
    "ssim",
    "ms_ssim",
    "lpips",
    "flip",
    "iou",
    "miou",
    "recall",
    "f1",
    "sharpness",
    *(f"psnr_{region}" for region in REGIONS),
)
FOREGROUND_NAMES = ("psnr_foreground", "ssim_foreground", "iou")  # mean nothing without a mask


@dataclass(frozen=True)
class ViewPair:
    """One view, rendered and true.

    Attributes:
        prediction: (H, W, 3) u8 sRGB on black. alpha: (H, W) f32 0..1 of the render.
        truth: (H, W, 3) u8 sRGB on black. mask: (H, W) u8 coverage 0..255.
        prediction_labels, truth_labels: (H, W) u8 label ids, 255 none; or None.
    """

    prediction: Picture
    alpha: NDArray[np.float32]
    truth: Picture
    mask: NDArray[np.uint8]
    prediction_labels: Labels | None = None
    truth_labels: Labels | None = None


def view_scores(view: ViewPair, perceptual: Perceptual | None = None) -> Scores:
    """Every score of a view by its name (`NAMES`); None where it cannot be computed.

    - `psnr_foreground`: over pixels with mask > 127. `ssim_foreground`: Gaussian window, their bounding box.
    - `psnr`, `ssim`: as published avatars are scored: white outside the mask in both, whole picture, uniform
      window.
    - `ms_ssim`: SSIM on five scales, white outside the mask, whole picture; None below 176 px.
    - `iou`: alpha > 0.5 against mask > 127. `miou`, `recall`, `f1`: garment labels.
    - `sharpness`: gradient energy over the truth's. `psnr_upper` …: inside the true label regions.
    - `lpips`: with a metric only; the mask's box and 50 px, on a white square of 512 px.
    - `flip`: mean over the foreground of the felt difference, 0 equal to 1, both pictures white outside the
      mask (LDR-FLIP at 67 pixels per degree); needs no weights, smaller is better.
    """
    inside = view.mask > MASK_THRESHOLD
    outside = ~inside[..., None]
    prediction_on_white = np.where(outside, np.uint8(255), view.prediction)
    truth_on_white = np.where(outside, np.uint8(255), view.truth)
    scores: Scores = dict.fromkeys(NAMES)
    scores |= {
        "psnr_foreground": psnr(view.prediction, view.truth, inside),
        "ssim_foreground": ssim_in_box(view.prediction, view.truth, inside),
        "psnr": psnr(prediction_on_white, truth_on_white),
        "ssim": ssim(prediction_on_white, truth_on_white, window="uniform"),
        "ms_ssim": ms_ssim(prediction_on_white, truth_on_white),
        "iou": iou(view.alpha > 0.5, inside),
        "flip": flip(prediction_on_white, truth_on_white, inside),
        "sharpness": sharpness(view.prediction, view.truth, inside),
    }
    if perceptual is not None:
        scores["lpips"] = _lpips(perceptual, prediction_on_white, truth_on_white, inside)
    if view.truth_labels is not None:
        for region, labels in REGIONS.items():
            member = inside & np.isin(view.truth_labels, labels)
            if member.sum() >= _SMALLEST_REGION:
                scores[f"psnr_{region}"] = psnr(view.prediction, view.truth, member)
    if view.truth_labels is not None and view.prediction_labels is not None:
        scores |= segmentation_scores(view.prediction_labels, view.truth_labels)
    return scores


def _lpips(
    perceptual: Perceptual, prediction: Picture, truth: Picture, inside: NDArray[np.bool_]
) -> float | None:
    """LPIPS of the subject's crop, pictures on white; None where the mask is empty."""
    box = mask_box(torch.from_numpy(inside), _LPIPS_MARGIN)
    if box is None:
        return None
    white = torch.ones(3)
    crops = [
        square_crop(torch.from_numpy(picture).float() / 255.0, box, _LPIPS_SIDE, white)
        for picture in (prediction, truth)
    ]
    with torch.no_grad():
        return float(perceptual.distance(*crops))


def mean_scores(rows: Iterable[Scores]) -> Scores:
    """Mean of each score over the views that have it; None where none has, or where it is infinite."""
    rows = list(rows)
    means: Scores = {}
    for name in NAMES:
        values = [value for row in rows if (value := row.get(name)) is not None]
        mean = float(np.mean(values)) if values else None
        means[name] = mean if mean is not None and math.isfinite(mean) else None
    return means

"""Masks from a picture of the empty scene: what differs from it is the person, shadows are not."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.vision.edges import largest_person

_Image = NDArray[np.uint8]
Singles = NDArray[np.float32]

_DARKEST_SHADOW = 0.45  # a shadow leaves at least so much of the light
_BRIGHTEST = 1.15
_BLUR = 1.0  # pixels, against noise
_NOISE_FLOOR = 4.0  # grey levels
_SURE = 8.0  # noise levels at which a difference is certain


def background_model(pictures: list[_Image]) -> tuple[Singles, Singles]:
    """Median (H, W, 3) f32 and noise (H, W) f32, grey levels, of pictures of the empty scene."""
    stack = np.stack(pictures).astype(np.float32)
    median = np.median(stack, axis=0).astype(np.float32)
    away = np.abs(stack - median).mean(axis=-1)
    noise = 1.4826 * np.median(away, axis=0) if len(pictures) > 2 else np.zeros(median.shape[:2])
    smooth = cv2.GaussianBlur(np.maximum(noise, _NOISE_FLOOR).astype(np.float32), (0, 0), 2.0)
    return median, np.asarray(smooth, np.float32)


def mask_from_background(image: _Image, median: Singles, noise: Singles) -> _Image:
    """(H, W) u8 coverage of what is not in the empty scene.

    A pixel that is the background's colour, only darker, is a shadow and counts as far as it is not explained
    by that (T. Horprasert et al., A statistical approach for background subtraction, 1999).
    """
    sharp = _certainty(image.astype(np.float32), median, noise)
    smooth = _certainty(_smooth(image), _smooth(median), noise)
    # Smooth pictures have less noise, sharp ones have the person's edge where it is.
    mask = np.rint(255 * np.sqrt(sharp * smooth)).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    mask = np.asarray(
        cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel)
    )
    return largest_person(_filled(mask), 0.05)


def _smooth(picture: NDArray) -> Singles:
    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR), np.float32)


def _certainty(picture: Singles, median: Singles, noise: Singles) -> Singles:
    """(H, W) f32 in [0, 1]: how far a pixel is no more or less lit pixel of the empty scene."""
    squared = np.maximum((median**2).sum(axis=-1), 1.0)
    brightness = np.clip((picture * median).sum(axis=-1) / squared, _DARKEST_SHADOW, _BRIGHTEST)
    colour = np.sqrt(((picture - brightness[..., None] * median) ** 2).mean(axis=-1))
    return np.asarray(np.clip(colour / (noise * _SURE), 0, 1), np.float32)


def _filled(mask: _Image) -> _Image:
    """The mask with holes closed that are much smaller than the person."""
    inside = (mask > 127).astype(np.uint8)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(1 - inside, connectivity=4)
    area = int(inside.sum())
    small = [number for number in range(1, count) if statistics[number, cv2.CC_STAT_AREA] < 0.01 * area]
    return np.where(np.isin(labels, small) & (inside == 0), np.uint8(255), mask)

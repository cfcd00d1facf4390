"""A soft mask of a network or of a difference made sharp at the edges of the picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_Image = NDArray[np.uint8]

_WORKING_HEIGHT = 480  # pixels of the person's height at which the cut is made; more is slow and no better
_BAND = 0.011  # of the person's height: how far the edge may move
_SURE = 230
_ROUNDS = 2
_SMOOTH_RADIUS, _SMOOTH_EPSILON = 4, 1e-4


def sharpened_mask(image: _Image, mask: _Image) -> _Image:
    """(H, W) u8 coverage whose edge lies on an edge of the picture, near to that of `mask`.

    A graph cut (C. Rother et al., GrabCut, 2004) decides in a band around the edge, a guided filter (K. He et
    al., Guided image filtering, 2010) gives the edge its soft pixels back. An empty mask stays as it is.

    Arguments:
        image: (H, W, 3) u8. mask: (H, W) u8, 0 to 255.
    """
    rows, columns = np.nonzero(mask > 127)
    if len(rows) < 16:
        return mask
    height = int(rows.max() - rows.min() + 1)
    margin = int(4 * _BAND * height) + 8
    top, left = max(int(rows.min()) - margin, 0), max(int(columns.min()) - margin, 0)
    part = np.s_[top : int(rows.max()) + margin + 1, left : int(columns.max()) + margin + 1]
    scale = min(1.0, _WORKING_HEIGHT / height)
    small = _resized(image[part], scale), _resized(mask[part], scale)
    cut = _cut(*small, max(2, round(_BAND * height * scale)))
    if cut is None:
        return mask
    height_part, width_part = mask[part].shape
    wide = cv2.resize(cut, (width_part, height_part), interpolation=cv2.INTER_LINEAR)
    guide = np.ascontiguousarray(image[part])
    soft = cv2.ximgproc.guidedFilter(
        guide, wide.astype(np.float32) / 255, _SMOOTH_RADIUS, _SMOOTH_EPSILON * 255**2
    )
    result = np.zeros_like(mask)
    result[part] = np.rint(255 * np.clip(soft, 0, 1)).astype(np.uint8)
    return result


def largest_person(mask: _Image, least_share: float = 0.02) -> _Image:
    """The mask without parts that are smaller than a share of the largest one."""
    inside = (mask > 127).astype(np.uint8)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(inside)
    if count < 2:
        return mask
    areas = statistics[1:, cv2.CC_STAT_AREA]
    kept = np.flatnonzero(areas >= least_share * areas.max()) + 1
    return np.where(np.isin(labels, kept) | (inside == 0), mask, 0).astype(np.uint8)


def _cut(image: _Image, mask: _Image, band: int) -> _Image | None:
    """(h, w) u8 0 or 255 by GrabCut; None where there is nothing to learn colours from."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inside = (mask > 127).astype(np.uint8)
    surely = (cv2.erode(inside, kernel) > 0) & (mask > _SURE)
    possibly = cv2.dilate(inside, kernel) > 0
    if surely.sum() < 16 or possibly.all():
        return None
    trimap = np.where(possibly, np.where(inside > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD), cv2.GC_BGD)
    trimap = np.where(surely, cv2.GC_FGD, trimap).astype(np.uint8)
    cv2.setRNGSeed(0)  # its colour models begin with random clusters
    models = np.zeros((1, 65)), np.zeros((1, 65))
    picture = np.ascontiguousarray(image[..., ::-1])
    cv2.grabCut(picture, trimap, (0, 0, 1, 1), *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.where(np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD)), 255, 0).astype(np.uint8)


def _resized(picture: _Image, scale: float) -> _Image:
    if scale == 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)

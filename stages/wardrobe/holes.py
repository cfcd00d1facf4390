"""Holes in a rendered person: small places inside the outline that let the background through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_SOLID = 0.5  # alpha from which a pixel counts as covered
_LARGEST = 0.004  # share of the person: larger gaps are those between limbs


def hole_pixels(alpha: NDArray[np.float32]) -> int:
    """Number of uncovered pixels of (H, W) alpha in gaps that are enclosed by the person and small."""
    covered = alpha >= _SOLID
    gaps, count = ndimage.label(ndimage.binary_fill_holes(covered) & ~covered)
    sizes = np.bincount(gaps.ravel(), minlength=count + 1)[1:]
    return int(sizes[sizes <= _LARGEST * covered.sum()].sum())

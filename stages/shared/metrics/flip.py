"""FLIP (Andersson et al. 2020): perceived difference of two pictures shown in alternation. Needs no weights.

Both pictures are filtered by the contrast sensitivity of the eye at a viewing distance, per opponent
channel, and compared in a perceptually uniform colour space. Differences at edges and points have more
weight.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.metrics.picture import Picture, check_pictures

PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * np.pi / 180  # 0.7 m before a 0.7 m wide screen of 3840 px
REACH = 13  # px that a pixel's surroundings matter, at that distance

Floats = NDArray[np.float32]

# Contrast sensitivity of luminance, red–green and blue–yellow as sums of Gaussians: (a, b) each.
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_FEATURE_WIDTH = 0.082  # degrees
_COLOR_EXPONENT, _FEATURE_EXPONENT = 0.7, 0.5
_KNEE, _AT_KNEE = 0.4, 0.95  # of the largest difference; what is beyond it is compressed

_XYZ_FROM_RGB = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    np.float32,
)
_RGB_FROM_XYZ = np.linalg.inv(_XYZ_FROM_RGB)
_WHITE = _XYZ_FROM_RGB.sum(axis=1)
_GREY = np.arange(256, dtype=np.float32) / 255
_LINEAR = np.where(_GREY > 0.04045, ((_GREY + 0.055) / 1.055) ** 2.4, _GREY / 12.92).astype(np.float32)


def flip_map(prediction: Picture, truth: Picture) -> NDArray[np.float32]:
    """(H, W) felt difference of every pixel, 0 equal to 1.

    Arguments:
        prediction, truth: (H, W, 3) u8 sRGB.
    """
    check_pictures(prediction, truth)
    test, reference = (_opponent(_xyz(picture)) for picture in (prediction, truth))
    color = _redistributed(_hyab(_hunt_lab(_as_seen(test)), _hunt_lab(_as_seen(reference))))
    feature = _feature_difference(_lightness(test), _lightness(reference))
    return np.asarray(color ** (1 - feature), dtype=np.float32)


def flip(prediction: Picture, truth: Picture, inside: NDArray[np.bool_] | None = None) -> float | None:
    """Mean of the map over the pixels `inside` (H, W), or over all; None where no pixel counts."""
    check_pictures(prediction, truth)
    if inside is None:
        return float(flip_map(prediction, truth).mean())
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return None
    box = (
        slice(max(0, rows[0] - REACH), rows[-1] + 1 + REACH),
        slice(max(0, columns[0] - REACH), columns[-1] + 1 + REACH),
    )
    return float(flip_map(prediction[box], truth[box])[inside[box]].mean())


def _xyz(picture: Picture) -> Floats:
    return np.asarray(_LINEAR[picture] @ _XYZ_FROM_RGB.T)


def _opponent(xyz: Floats) -> Floats:
    """YCxCz: like CIELAB, but linear, so that blurring means what it does to light."""
    x, y, z = np.moveaxis(xyz / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _lightness(opponent: Floats) -> Floats:
    """0..1."""
    return np.asarray((opponent[..., 0] + 16) / 116, dtype=np.float32)


def _as_seen(opponent: Floats) -> Floats:
    """Blurred by the contrast sensitivity, as XYZ of colours a screen can show."""
    radius = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * PIXELS_PER_DEGREE))
    steps = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    blurred = np.empty_like(opponent)
    for channel, parts in enumerate(_SENSITIVITY):
        image = np.ascontiguousarray(opponent[..., channel])
        total, weight = np.zeros_like(image), 0.0
        for height, width in parts:
            profile = np.exp(-(np.pi**2) * steps**2 / width)
            share = height * np.sqrt(np.pi / width) * profile.sum() ** 2
            total += share * _filtered(image, profile / profile.sum(), profile / profile.sum())
            weight += share
        blurred[..., channel] = total / weight
    y = _lightness(blurred)
    xyz = np.stack([y + blurred[..., 1] / 500, y, y - blurred[..., 2] / 200], axis=-1) * _WHITE
    rgb = np.clip(xyz @ _RGB_FROM_XYZ.T, 0, 1)
    return np.asarray(rgb @ _XYZ_FROM_RGB.T)


def _hunt_lab(xyz: Floats) -> Floats:
    """CIELAB with chroma that fades in the dark (Hunt)."""
    ratio = xyz / _WHITE
    delta = 6 / 29
    curve = np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3 * delta**2) + 4 / 29)
    x, y, z = np.moveaxis(curve, -1, 0)
    lightness = 116 * y - 16
    return np.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], axis=-1)


def _hyab(first: Floats, second: Floats) -> Floats:
    """City-block distance in lightness plus Euclidean distance in chroma."""
    difference = first - second
    return np.asarray(np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2]))


def _redistributed(distance: Floats) -> Floats:
    """Distances as 0..1: most of the range for the smaller ones, the rest for what lies beyond the knee."""
    green, blue = (_hunt_lab(_XYZ_FROM_RGB[:, index]) for index in (1, 2))
    largest = float(_hyab(green, blue)) ** _COLOR_EXPONENT
    knee = _KNEE * largest
    felt = distance**_COLOR_EXPONENT
    beyond = _AT_KNEE + (felt - knee) / (largest - knee) * (1 - _AT_KNEE)
    return np.where(felt < knee, _AT_KNEE / knee * felt, beyond)


def _feature_difference(test: Floats, reference: Floats) -> Floats:
    """0..1: how differently edges and points show in two luminances."""
    spread = 0.5 * _FEATURE_WIDTH * PIXELS_PER_DEGREE
    steps = np.arange(-np.ceil(3 * spread), np.ceil(3 * spread) + 1)
    bell = np.exp(-(steps**2) / (2 * spread**2))
    strongest = np.zeros_like(test)
    for profile in (-steps * bell, (steps**2 / spread**2 - 1) * bell):
        halves = np.where(profile < 0, -profile[profile < 0].sum(), profile[profile > 0].sum())
        profile = profile / halves
        strength = [
            np.hypot(_filtered(y, profile, bell / bell.sum()), _filtered(y, bell / bell.sum(), profile))
            for y in (reference, test)
        ]
        strongest = np.maximum(strongest, np.abs(strength[0] - strength[1]))
    return np.asarray((strongest / np.sqrt(2)) ** _FEATURE_EXPONENT)


def _filtered(image: Floats, across: Floats, down: Floats) -> Floats:
    """Correlation with an outer product, borders repeated."""
    return np.asarray(
        cv2.sepFilter2D(
            np.ascontiguousarray(image), cv2.CV_32F, across, down, borderType=cv2.BORDER_REPLICATE
        )
    )

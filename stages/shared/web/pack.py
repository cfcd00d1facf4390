"""Gaussians as bytes for a browser: 22 for each, read by `unpackGaussians` in viewer.js.

"GSW2", u32 length of a JSON text, the text, then columns, each padded to 4 bytes, little-endian: positions
(N,3) u16 over their range, covariances (N,6) f16 in units of `unit` m² (xx xy xz yy yz zz), colour and
opacity (N,4) u8. The text states count, ranges, unit, and layers as stretches of Gaussians.

At a person's size, positions are rounded to 0.03 mm, entries of covariances to 0.05 %.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.canonical import canonical_json
from stages.shared.splat.gaussians import Gaussians

MAGIC = 0x32575347
UNIT = 1e-6  # m²: a Gaussian of 1 mm has variance 1, well inside of what 16 bits hold
_LARGEST = 65504.0
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


def pack_gaussians(gaussians: Gaussians, **about: int) -> bytes:
    """The bytes of all Gaussians, layer after layer; `about` goes into the text."""
    ids = gaussians.layer_ids.numpy()
    counts = np.bincount(ids, minlength=len(gaussians.layers))
    means, covariances = gaussians.means.numpy(), gaussians.covariances.numpy()[:, _UPPER[0], _UPPER[1]]
    tints = np.column_stack([gaussians.features[:, :3].numpy(), gaussians.opacities.numpy()])
    if len(ids) and (np.diff(ids) < 0).any():
        order = np.argsort(ids, kind="stable")
        means, covariances, tints = means[order], covariances[order], tints[order]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    places, ranges = zip(*(quantised(axis) for axis in means.T), strict=True)
    info = {
        "count": len(ids),
        "unit": UNIT,
        "layers": [
            {"name": name, "start": start, "count": count}
            for name, start, count in zip(gaussians.layers, starts, counts, strict=True)
            if count
        ],
        "places": ranges,
        **about,
    }
    columns = (np.column_stack(places), half_covariances(covariances), color_bytes(tints))
    return packed(MAGIC, info, columns)


def packed(magic: int, info: object, columns: tuple[NDArray[np.generic], ...]) -> bytes:
    """Magic number, length of a JSON text, the text, and columns, each padded to four bytes."""
    text = canonical_json(info)
    parts = [text, *(np.ascontiguousarray(column).tobytes() for column in columns)]
    return struct.pack("<II", magic, len(text)) + b"".join(part + b"\0" * (-len(part) % 4) for part in parts)


def half_covariances(upper: NDArray[np.floating]) -> NDArray[np.float16]:
    """(N, 6) f16 in units of `UNIT` of covariances in m²."""
    return np.clip(upper * np.float32(1 / UNIT), -_LARGEST, _LARGEST).astype("<f2")


def color_bytes(tints: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(N, 4) u8 of colours and opacities 0..1."""
    return np.rint(255 * np.clip(tints, 0, 1)).astype(np.uint8)


def quantised(values: NDArray[np.floating], bits: int = 16) -> tuple[NDArray[np.uint16], list[float]]:
    """Values as 0..2^bits − 1 between their least and greatest, and these two."""
    if not values.size:
        return np.zeros(values.shape, "<u2"), [0.0, 0.0]
    low, high = float(values.min()), float(values.max())
    scale = (2**bits - 1) / (high - low) if high > low else 0.0
    return np.rint((values.astype(np.float64) - low) * scale).astype("<u2"), [low, high]

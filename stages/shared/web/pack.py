"""Gaussians as bytes for a browser: 24 a piece, read by `unpackGaussians` in viewer.js.

"GSWS", u32 length of a JSON text, the text, then columns, each padded to 4 bytes, little-endian: positions
(N,3) u16 over their range, quaternions (N,4) i16 wxyz, logarithms of the scales (N,3) u16 over their range,
colour and opacity (N,4) u8. The text states count, ranges, and layers as stretches of Gaussians.

At a person's size, positions are rounded to 0.03 mm, rotations to 0.005°, scales to 0.02 %.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.canonical import canonical_json
from stages.shared.export.cloud import cloud_of
from stages.shared.splat.gaussians import Gaussians

_MAGIC = 0x53575347


def pack_gaussians(composite: Gaussians) -> bytes:
    """The bytes of all Gaussians, layer after layer."""
    order = np.argsort(composite.layer_ids.numpy(), kind="stable")
    cloud = cloud_of(composite)
    assert cloud.layers is not None
    counts = np.bincount(cloud.layers, minlength=len(composite.layers))
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    places, ranges = zip(*(_spread(axis) for axis in cloud.means[order].T), strict=True)
    sizes, size_range = _spread(np.log(cloud.scales[order]))
    tints = np.column_stack([cloud.colors, cloud.opacities])[order]
    info = {
        "count": len(order),
        "layers": [
            {"name": name, "start": start, "count": count}
            for name, start, count in zip(composite.layers, starts, counts, strict=True)
            if count
        ],
        "places": ranges,
        "sizes": size_range,
    }
    text = canonical_json(info)
    columns = (
        np.column_stack(places),
        np.rint(32767 * cloud.quats[order]).astype("<i2"),
        sizes,
        np.rint(255 * np.clip(tints, 0, 1)).astype(np.uint8),
    )
    parts = [text, *(column.tobytes() for column in columns)]
    return struct.pack("<II", _MAGIC, len(text)) + b"".join(part + b"\0" * (-len(part) % 4) for part in parts)


def _spread(values: NDArray[np.float32]) -> tuple[NDArray[np.uint16], list[float]]:
    """Values as 0..65535 between their least and greatest, and these two."""
    if not values.size:
        return np.zeros(values.shape, "<u2"), [0.0, 0.0]
    low, high = float(values.min()), float(values.max())
    scale = 65535 / (high - low) if high > low else 0.0
    return np.rint((values.astype(np.float64) - low) * scale).astype("<u2"), [low, high]

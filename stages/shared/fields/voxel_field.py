"""A smooth function of space on a regular grid of nodes, stored only where it was computed.

Nodes lie on `linspace(centre − half_extent, centre + half_extent)` along each axis (so the outermost
nodes are on the faces of the box). Only a band of nodes stores values. Every other node uses the values of
the nearest node of the band, and points outside the box use those of its border. Sampling is therefore
defined everywhere and never returns zeros by accident.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from stages.shared.finite import finite, require_finite

_CHUNK = 32_768  # points sampled at a time: bounds memory at 8 corners x channels


@dataclass(frozen=True)
class VoxelField:
    """C channels on a (D, H, W) grid over an axis-aligned box; x runs along W, y along H, z along D.

    Attributes:
        values: (M, C) float32, one row per node of the band.
        rows: (D, H, W) int32, the row of `values` that each node reads.
        centre: (3,) float64, middle of the box, metres.
        half_extent: (3,) float64, half the sides of the box, metres.
    """

    values: np.ndarray
    rows: np.ndarray
    centre: np.ndarray
    half_extent: np.ndarray

    @classmethod
    def from_band(
        cls, values: np.ndarray, band: np.ndarray, centre: np.ndarray, half_extent: np.ndarray
    ) -> VoxelField:
        """A field from values (M, C) at the nodes where band (D, H, W) is true, in raster order."""
        return cls(
            np.ascontiguousarray(values, dtype=np.float32),
            nearest_rows(band),
            np.asarray(centre, float),
            np.asarray(half_extent, float),
        )

    @property
    def channels(self) -> int:
        return self.values.shape[1]

    @property
    def dense(self) -> np.ndarray:
        """(C, D, H, W) float32: the value of every node."""
        return np.moveaxis(self.values[self.rows], -1, 0)

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Trilinear values at points (N, 3), metres -> (N, C) float64; outside the box: its border.

        Raises BadData, naming array and index, for numbers that are not finite.
        """
        points = np.asarray(points, dtype=np.float64)
        require_finite("VoxelField.sample", points=points)
        sampled = np.empty((len(points), self.channels))
        for start in range(0, len(points), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            sampled[chunk] = self._sample_chunk(points[chunk])
        return finite(sampled, "VoxelField.sample", values=self.values)

    def _sample_chunk(self, points: np.ndarray) -> np.ndarray:
        sizes = np.array(self.rows.shape[::-1])  # W, H, D
        unit = (points - self.centre) / (2.0 * self.half_extent) + 0.5
        position = np.clip(unit, 0.0, 1.0) * (sizes - 1)
        low = np.minimum(position.astype(np.int64), np.maximum(sizes - 2, 0))
        high = np.minimum(low + 1, sizes - 1)
        share = position - low
        total = np.zeros((len(points), self.channels))
        for corner in range(8):
            upper = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1], dtype=bool)
            x, y, z = np.where(upper, high, low).T
            weight = np.where(upper, share, 1.0 - share).prod(axis=1)
            total += weight[:, None] * self.values[self.rows[z, y, x]]
        return total

    def to_arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """Arrays for an artifact: values (M, C), rows (D, H, W), box (2, 3) of centre and half extent."""
        return {
            f"{prefix}.values": self.values,
            f"{prefix}.rows": self.rows,
            f"{prefix}.box": np.stack([self.centre, self.half_extent]).astype(np.float32),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], prefix: str) -> VoxelField:
        """The inverse of `to_arrays`."""
        centre, half_extent = arrays[f"{prefix}.box"].astype(np.float64)
        return cls(arrays[f"{prefix}.values"], arrays[f"{prefix}.rows"], centre, half_extent)


def node_positions(shape: tuple[int, int, int], centre: np.ndarray, half_extent: np.ndarray) -> np.ndarray:
    """World positions (D, H, W, 3) of the nodes of a grid, metres."""
    depth, height, width = shape
    axes = [
        np.linspace(c - e, c + e, n)
        for c, e, n in zip(centre, half_extent, (width, height, depth), strict=True)
    ]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return np.stack([x, y, z], axis=-1)


def nearest_rows(band: np.ndarray) -> np.ndarray:
    """For a mask (D, H, W): the raster number, among true nodes, of each node's nearest true node."""
    if not band.any():
        raise ValueError("band has no node")
    numbers = np.cumsum(band.ravel()).reshape(band.shape).astype(np.int32) - 1
    indices = ndimage.distance_transform_edt(~band, return_distances=False, return_indices=True)
    return np.ascontiguousarray(numbers[tuple(indices)])

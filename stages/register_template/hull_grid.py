"""The regular grid on which a hull is carved, and the pixels that its nodes share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.register_template.silhouettes import Doubles, Silhouette

_BIN_STEPS = 1.5  # side of the bins in which pixels are compared, in projected grid steps


@dataclass(frozen=True)
class Grid:
    """Nodes of a regular grid: x varies fastest, then y, then z."""

    low: Doubles
    pitch: float
    shape: tuple[int, int, int]  # z, y, x

    def nodes(self) -> Doubles:
        z, y, x = (np.arange(count) * self.pitch for count in self.shape)
        mesh = np.meshgrid(z + self.low[2], y + self.low[1], x + self.low[0], indexing="ij")
        return np.stack([axis.reshape(-1) for axis in mesh[::-1]], axis=1)


def grid_between(low: Doubles, high: Doubles, pitch: float) -> Grid:
    counts = np.ceil((high - low) / pitch).astype(int) + 1
    return Grid(low, pitch, (int(counts[2]), int(counts[1]), int(counts[0])))


def least_in_bins(
    one: Silhouette, grid: Grid, depth: Doubles, pixels: Doubles, values: Doubles
) -> NDArray[np.intp]:
    """The point with the smallest value in each bin of an image, of N points at pixels (N, 2); values (N,).

    Arguments:
        depth: of all points that are compared, metres; with the grid step it gives the size of the bins.
    """
    side = np.ceil(_BIN_STEPS * grid.pitch * one.focal / np.median(depth))
    columns = int(np.ceil(one.camera.width / side)) + 1
    bins = (pixels[:, 1] // side).astype(np.int64) * columns + (pixels[:, 0] // side).astype(np.int64)
    order = np.lexsort((values, bins))
    return np.asarray(order[np.unique(bins[order], return_index=True)[1]])

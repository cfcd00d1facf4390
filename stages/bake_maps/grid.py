"""The square grid of texels that all layers and subjects share, and the window of it that a layer needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.shared.errors import BadData


@dataclass(frozen=True)
class Grid:
    """S x S texels around the centre of the zero-shape body; the same texel is the same (x, y) for everybody.

    Texel (row, column) sits at x = c_x + ((column + ½) − S/2)·pitch, y = c_y − ((row + ½) − S/2)·pitch, in
    both views; the back view is stored as seen through the front, so columns agree.

    Attributes:
        size: S.
        pitch: metres per texel.
        centre: (3,) metres, canonical.
    """

    size: int
    pitch: float
    centre: np.ndarray

    @classmethod
    def around(cls, body_vertices: np.ndarray, pitch: float, extent: float) -> Grid:
        """The grid of at least `extent` metres around the bounding box of body vertices (V, 3)."""
        centre = (body_vertices.min(axis=0) + body_vertices.max(axis=0)).astype(np.float64) / 2
        return cls(math.ceil(extent / pitch - 1e-9), pitch, centre)

    def window(self, vertices: np.ndarray, layer: str) -> tuple[int, int, int, int]:
        """Smallest window (row0, column0, height, width) of the texels that a mesh of vertices (V, 3) covers.

        Raises:
            BadData: the layer reaches beyond the grid; says how far.
        """
        across = (vertices[:, 0] - self.centre[0]) / self.pitch + self.size / 2
        down = (self.centre[1] - vertices[:, 1]) / self.pitch + self.size / 2
        low = np.floor([down.min(), across.min()])
        high = np.ceil([down.max(), across.max()])
        beyond = max(-low.min(), high.max() - self.size)
        if beyond > 0:
            raise self._overflow(vertices, layer)
        (row, column), (height, width) = low.astype(int), np.maximum(high - low, 1).astype(int)
        return int(row), int(column), int(height), int(width)

    def _overflow(self, vertices: np.ndarray, layer: str) -> BadData:
        half = self.size * self.pitch / 2
        sides = {
            "left": vertices[:, 0].max() - self.centre[0],
            "right": self.centre[0] - vertices[:, 0].min(),
            "top": vertices[:, 1].max() - self.centre[1],
            "bottom": self.centre[1] - vertices[:, 1].min(),
        }
        text = ", ".join(f"{side} {reach - half:.3f} m" for side, reach in sides.items() if reach > half)
        needed = 2 * max(sides.values())
        return BadData(
            f"The layer {layer} reaches beyond the {2 * half:.2f} m map (over by: {text}).",
            f"layer {layer}, canonical pose",
            f"Give gw bake-maps --extent {math.ceil(needed * 10) / 10:.1f}, or clean the template.",
        )

    def positions(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """(N, 2) canonical x y, metres, of texel centres."""
        x = self.centre[0] + (columns + 0.5 - self.size / 2) * self.pitch
        y = self.centre[1] - (rows + 0.5 - self.size / 2) * self.pitch
        return np.stack([x, y], axis=-1)

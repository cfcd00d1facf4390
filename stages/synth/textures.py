"""Fabric patterns as functions of texture coordinates in metres, evaluated where a ray hits: always crisp.

A fabric is a row of numbers (see `Fabric.row`) so that compiled code can shade millions of hits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.shared.pictures.srgb import linear_from_srgb

Rgb = tuple[float, float, float]

VERTEX_COLORS, STRIPES, TARTAN, CHECKS, DOTS, ARGYLE = range(6)
ROW_LENGTH = 20


@dataclass(frozen=True)
class Fabric:
    """A pattern and its colours.

    Attributes:
        kind: one of the constants above; VERTEX_COLORS takes the mesh's own colours.
        period: metres after which the pattern repeats, in both directions.
        colors: up to four albedos, sRGB 0..1; the first is the ground.
        emblem: None, or (u, v, radius) in metres of a round badge.
    """

    kind: int
    period: float = 1.0
    colors: tuple[Rgb, ...] = ((0.7, 0.7, 0.7),)
    emblem: tuple[float, float, float] | None = None

    def row(self) -> NDArray[np.float64]:
        """(20,) kind, period, 4 colours linear rgb, emblem u v radius (radius 0 for none), 3 spare."""
        row = np.zeros(ROW_LENGTH)
        row[0], row[1] = self.kind, self.period
        for slot in range(4):
            color = self.colors[min(slot, len(self.colors) - 1)]
            row[2 + 3 * slot : 5 + 3 * slot] = linear_from_srgb(np.asarray(color, dtype=np.float64))
        if self.emblem is not None:
            row[14:17] = self.emblem
        return row


@njit(cache=True, nogil=True)
def fabric_color(row, u, v, out):  # type: ignore[no-untyped-def]
    """Write the linear albedo of a fabric row at (u, v) metres to out (3,)."""
    slot = _slot(int(row[0]), u / row[1], v / row[1])
    if slot < 4:
        for c in range(3):
            out[c] = row[2 + 3 * slot + c]
    else:  # half-way tones where the two threads of a weave cross
        first, second = (slot - 4) // 4, (slot - 4) % 4
        for c in range(3):
            out[c] = 0.5 * (row[2 + 3 * first + c] + row[2 + 3 * second + c])
    if row[16] > 0.0:
        distance = np.hypot(u - row[14], v - row[15]) / row[16]
        if distance < 1.0:
            angle = np.arctan2(v - row[15], u - row[14])
            star = 0.36 + 0.16 * np.cos(5.0 * (angle - 0.5 * np.pi))
            ring = distance > 0.84 or distance < star
            for c in range(3):
                out[c] = row[11 + c] if ring else row[8 + c]


@njit(cache=True, nogil=True)
def _slot(kind, s, t):  # type: ignore[no-untyped-def]
    """Which colour (0..3), or 4 + 4·a + b for a half-and-half mix of colours a and b."""
    x, y = s - np.floor(s), t - np.floor(t)
    if kind == STRIPES:
        return 1 if y < 0.42 else 0
    if kind == TARTAN:
        a, b = _tartan_band(x), _tartan_band(y)
        return a if a == b else 4 + 4 * min(a, b) + max(a, b)
    if kind == CHECKS:
        a, b = x < 0.5, y < 0.5
        if a and b:
            return 1
        return 5 if a or b else 0
    if kind == DOTS:
        odd = y >= 0.5
        dx = (x + (0.5 if odd else 0.0)) % 1.0 - 0.5
        dy = (y % 0.5 - 0.25) * 1.0
        return 1 if dx * dx + dy * dy < 0.0256 else 0
    if kind == ARGYLE:
        diamond = abs(x - 0.5) + abs(y - 0.5)
        line = abs(abs(x - 0.5) - abs(y - 0.5))
        if line < 0.025:
            return 2
        return 1 if diamond < 0.5 else 0
    return 0


@njit(cache=True, nogil=True)
def _tartan_band(x):  # type: ignore[no-untyped-def]
    """Colour of one thread: ground, a broad band, two thin lines."""
    if 0.08 < x < 0.40:
        return 1
    if 0.72 < x < 0.765:
        return 2
    if 0.84 < x < 0.885:
        return 3
    return 0

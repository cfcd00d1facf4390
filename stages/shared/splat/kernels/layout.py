"""How pixels and Gaussians lie in memory; the same for all kernels.

The image is cut into tiles of 16 x 16 px, a tile into blocks as large as one register: 4 px wide, and 4 px
high with sixteen lanes or 2 px with eight. Squarish blocks waste fewer lanes on small Gaussians than rows do.
A list entry (tile, Gaussian) carries one bit per block of the tile, so that empty blocks cost nothing.
"""

from __future__ import annotations

import functools
import math

import llvmlite.binding
import numpy as np

from stages.shared.splat.settings import ALPHA_MAX, SplatSettings

TILE = 16
TILE_SHIFT = 4
TILE_PIXELS = TILE * TILE
BLOCK_WIDTH = 4
BLOCKS_ACROSS = TILE // BLOCK_WIDTH

# A record is what blending needs of one Gaussian. The centre is split into a whole number of pixels
# (exact, so that wide pictures lose no digits) and a rest that is folded into U0 and V0: with X, Y the pixel
# relative to the whole part, u = UX X + UY Y + U0, v = VY Y + V0, alpha = 2^(LOG_OPACITY - u^2 - v^2).
WHOLE_X, WHOLE_Y, UX, UY, U0, VY, V0, LOG_OPACITY, DEPTH, COLOR = range(10)

# A gradient slot holds sums over the pixels of one tile for one Gaussian, h = d(loss)/d(alpha) alpha:
# h, h u, h u X, h u Y, h v, h v Y, then d(loss)/d(depth) and d(loss)/d(colours).
SUM_H, SUM_HU, SUM_HUX, SUM_HUY, SUM_HV, SUM_HVY, SUM_DEPTH, SUM_COLOR = range(8)

GROUP = 64
"""Gaussians that projection handles at once: enough to amortise the transposition, small enough for L1."""

GROUPS_PER_TURN = 4
"""Groups per work item."""

SPECIALISED_CHANNELS = range(1, 9)
"""Channel counts with specialised code, compiled on first use; others share one general version."""


@functools.cache
def host_lanes(precision: str = "single") -> int:
    """Lanes of the host's registers: 16 floats with AVX-512, else 8 (LLVM splits them where it must)."""
    return 16 if precision == "single" and llvmlite.binding.get_host_cpu_features().get("avx512f") else 8


def lanes_argument(count: int) -> tuple[int, ...]:
    """The `lanes` argument of a kernel."""
    return (0,) * count


def size_argument(count: int, specialised: bool) -> tuple[int, ...] | int:
    """A size the compiler knows, or one it does not."""
    return (0,) * count if specialised else count


def record_length(channels: int) -> int:
    """Floats per record: whole cache lines."""
    return -(-(COLOR + channels) // 16) * 16


def slot_length(channels: int, lanes: int) -> int:
    """Floats per gradient slot: whole registers."""
    return -(-(SUM_COLOR + channels) // lanes) * lanes


# The constants of the blending kernels come in an array: numbers in registers instead of in the code.
# For powers of two: the number that rounds to an integer, which its low bits then hold, when added (1.5 times
# 2^23, or 2^52), and coefficients of 2^f for float32 (minimax of degree 5 on [-1/2, 1/2], relative error with
# rounding 2.1e-7; doubles take a longer series). Then the cut-off, in log2, the largest alpha, the stop.
_ROUNDING = {np.dtype(np.float32): 1.5 * 2.0**23, np.dtype(np.float64): 1.5 * 2.0**52}
_POWER = (1.0000001, 0.69314694, 0.2402212, 0.055507135, 0.009675542, 0.0013276464)
NUMBERS = 10
CUT = 7
"""Place of the cut-off among the numbers."""


@functools.cache
def constants(lanes: int, settings: SplatSettings = SplatSettings()) -> np.ndarray:
    """The numbers above, each `lanes` times; x, then y, of the lanes' pixel centres in a block (px).

    Then x, then y, of the middles of the tile's blocks. In the type that the pictures are computed in.
    """
    kind = element_type(settings)
    lane, block = np.arange(lanes), np.arange(TILE_PIXELS // lanes)
    block_height = lanes // BLOCK_WIDTH
    cuts = (math.log2(settings.alpha_min), ALPHA_MAX, settings.transmittance_min)
    rows = (
        np.repeat((_ROUNDING[kind], *_POWER, *cuts), lanes),
        lane % BLOCK_WIDTH + 0.5,
        lane // BLOCK_WIDTH + 0.5,
        (block % BLOCKS_ACROSS + 0.5) * BLOCK_WIDTH,
        (block // BLOCKS_ACROSS + 0.5) * block_height,
    )
    return np.concatenate(rows).astype(kind)


def element_type(settings: SplatSettings) -> np.dtype:
    """Element type of records, pictures and gradient slots."""
    return np.dtype(np.float64 if settings.precision == "double" else np.float32)

"""Alpha of a Gaussian on a block of pixels: the piece that both directions of blending share.

They must take the same decisions at the cut-offs bit for bit, so there is one copy, without reordering.
"""

from __future__ import annotations

import math

from numba import types
from numba.extending import overload

from stages.shared.splat.kernels.compiling import inlined
from stages.shared.splat.kernels.layout import (
    BLOCK_WIDTH,
    BLOCKS_ACROSS,
    LOG_OPACITY,
    U0,
    UX,
    UY,
    V0,
    VY,
    WHOLE_X,
    WHOLE_Y,
)
from stages.shared.splat.kernels.memory import at, broadcast, load
from stages.shared.splat.kernels.simd import fma, magnitude, minimum, negative, scale_by_low_bits, where

# mypy: ignore-errors
# (compiled and type-checked by numba)

LN2 = math.log(2.0)


@inlined
def numbers(constants, lanes):
    """The numbers of `layout.constants` in registers: shift, six coefficients, cut, largest alpha, stop."""
    n = len(lanes)
    return (
        load(constants, 0, lanes), load(constants, n, lanes), load(constants, 2 * n, lanes),
        load(constants, 3 * n, lanes), load(constants, 4 * n, lanes), load(constants, 5 * n, lanes),
        load(constants, 6 * n, lanes), load(constants, 7 * n, lanes), load(constants, 8 * n, lanes),
        load(constants, 9 * n, lanes),
    )  # fmt: skip


def power(exponent, number):
    """2^exponent: relative error 2.1e-7 in float32, under 1e-15 in float64; garbage far below the cut-off."""
    raise RuntimeError("for compiled code only")


@overload(power, jit_options={"forceinline": True, "error_model": "numpy"})
def _choose_power(exponent, number):
    if exponent.element == types.float32:
        return lambda exponent, number: _power_of_single(exponent, number)
    return lambda exponent, number: _power_of_double(exponent, number)


@inlined
def _power_of_single(exponent, number):
    shifted = exponent + number[0]
    fraction = exponent - (shifted - number[0])
    square = fraction * fraction
    low, middle = fma(number[2], fraction, number[1]), fma(number[4], fraction, number[3])
    high = fma(number[6], fraction, number[5])
    return scale_by_low_bits(fma(fma(high, square, middle), square, low), shifted)


@inlined
def _power_of_double(exponent, number):
    """The series of e^x at x = fraction ln 2, |x| < 0.35: the fifteenth term is under 1e-18."""
    shifted = exponent + number[0]
    x = (exponent - (shifted - number[0])) * LN2
    sum_ = x * 0.0 + 1.0
    for k in range(14, 0, -1):
        sum_ = fma(sum_, x * (1.0 / k), 1.0)
    return scale_by_low_bits(sum_, shifted)


@inlined
def falloff(pixel_x, pixel_y, records, record, number, lanes):
    """(X, Y, u, v, power of two, alpha, which lanes reach the cut); alpha is 0 where they do not.

    The power is 2^(log_opacity - u^2 - v^2); garbage far outside the Gaussian.
    """
    x, y = pixel_x - at(records, record + WHOLE_X), pixel_y - at(records, record + WHOLE_Y)
    ux, u_y = broadcast(at(records, record + UX), lanes), broadcast(at(records, record + UY), lanes)
    u = fma(ux, x, fma(u_y, y, broadcast(at(records, record + U0), lanes)))
    v = fma(broadcast(at(records, record + VY), lanes), y, broadcast(at(records, record + V0), lanes))
    exponent = fma(negative(u), u, fma(negative(v), v, broadcast(at(records, record + LOG_OPACITY), lanes)))
    keep = exponent >= number[7]
    raised = power(exponent, number)
    return x, y, u, v, raised, where(keep, minimum(raised, number[8]), 0.0), keep


@inlined
def pass_through(before, alpha, number):
    """Transmittance in front -> (weight, transmittance behind, which lanes are still open).

    A lane stops before the Gaussian that would take it to the limit, and keeps its transmittance, negative.
    """
    after = fma(negative(alpha), before, before)
    still_open = after > number[9]
    weight = where(still_open, before * alpha, 0.0)
    return weight, where(still_open, after, negative(magnitude(before))), still_open


@inlined
def pixel_place(row, column, count, planes):
    """Where pixel (row, column) of a tile is in a picture's state, laid out [block][plane][lane]."""
    height = count // BLOCK_WIDTH
    block = (row // height) * BLOCKS_ACROSS + column // BLOCK_WIDTH
    return block * planes * count + (row % height) * BLOCK_WIDTH + column % BLOCK_WIDTH


@inlined
def block_corner(block, count, top, left):
    """Pixel (x, y) of the first lane of a block of the tile at (top, left)."""
    x = left + (block % BLOCKS_ACROSS) * BLOCK_WIDTH
    y = top + (block // BLOCKS_ACROSS) * (count // BLOCK_WIDTH)
    return x, y

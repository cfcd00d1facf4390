"""Geometry of projection, eight Gaussians at a time in float64; forward and backward share it.

Doubles, because needles (one axis ten thousand times the other) lose all digits of their 2-D determinant in
float32, and because a vector of doubles costs little compared with the memory traffic. Each group of
Gaussians is transposed into a table (one row per quantity) that stays in L1; the mathematics then runs along
the rows.
Formulas: Zwicker et al. 2001 (EWA splatting); the names are those of `reference.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.shared.splat.kernels.compiling import inlined
from stages.shared.splat.kernels.layout import GROUP
from stages.shared.splat.kernels.memory import at, load, set_at, store
from stages.shared.splat.kernels.simd import (
    floor,
    fma,
    maximum,
    minimum,
    root,
    split_exponent,
    to_single,
    where,
)

# mypy: ignore-errors
# (compiled and type-checked by numba)

# A camera is 25 doubles: R (9), t (3), fx fy cx cy, limits of x/z and y/z (4), near, far, eps2d, antialiased,
# log2 of the least alpha.
R, T, FX, FY, CX, CY, LEFT, RIGHT, TOP, BOTTOM, NEAR, FAR, EPS2D, ANTIALIASED, CUT = (
    0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24,
)  # fmt: skip

WIDE = 8
EIGHT = (0,) * WIDE
"""Doubles in a register (two, or four, where the host has less)."""

HALF_LOG2E = 0.5 * math.log2(math.e)

# Rows of the table that hold the inputs: mean (3), quaternion and scales (7) or covariance (6), opacity.
MEAN, SHAPE, OPACITY, FIRST_FREE = 0, 3, 10, 11


@inlined
def row_of(table, row, place):
    return load(table, row * GROUP + place, EIGHT)


@inlined
def set_row(table, row, place, value):
    store(table, row * GROUP + place, value)


@inlined
def log2(a):
    """log2 of positive normal doubles, error under 1e-12: 2 atanh(s) / ln 2 with s = (m - 1) / (m + 1)."""
    mantissa, exponent = split_exponent(a)
    high = mantissa > 1.4142135623730951
    mantissa = where(high, mantissa * 0.5, mantissa)
    exponent = where(high, exponent + 1.0, exponent)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    s2 = s * s
    series = fma(
        s2, fma(s2, fma(s2, fma(s2, fma(s2, fma(s2, 1 / 13, 1 / 11), 1 / 9), 1 / 7), 1 / 5), 1 / 3), 1.0
    )
    return fma(s * series, 2.0 / math.log(2.0), exponent)


@inlined
def gather(table, group, count, means, quats, scales, covars, opacities):
    """Transpose `count` Gaussians into the table; the last one fills up the rest of the group."""
    for j in range(GROUP):
        g = group + min(j, count - 1)
        for k in range(3):
            set_at(table, (MEAN + k) * GROUP + j, np.float64(at(means, 3 * g + k)))
        # Two tests, not one with an else: what is None is then left out when compiling.
        if quats is not None:
            for k in range(4):
                set_at(table, (SHAPE + k) * GROUP + j, np.float64(at(quats, 4 * g + k)))
            for k in range(3):
                set_at(table, (SHAPE + 4 + k) * GROUP + j, np.float64(at(scales, 3 * g + k)))
        if covars is not None:
            place = SHAPE * GROUP + j
            for row in range(3):
                for column in range(row, 3):
                    upper, lower = at(covars, 9 * g + 3 * row + column), at(covars, 9 * g + 3 * column + row)
                    set_at(table, place, 0.5 * (np.float64(upper) + np.float64(lower)))
                    place += GROUP
        set_at(table, OPACITY * GROUP + j, np.float64(at(opacities, g)))


@inlined
def rotation(table, place):
    """Unit quaternion (w x y z), 1 / length of the given one, and the nine entries of its matrix."""
    w, x, y, z = (
        row_of(table, SHAPE, place),
        row_of(table, SHAPE + 1, place),
        row_of(table, SHAPE + 2, place),
        row_of(table, SHAPE + 3, place),
    )
    inverse = 1.0 / root(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    matrix = (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return (w, x, y, z), inverse, matrix


@inlined
def covariance_of(table, place, covars):
    """Entries xx xy xz yy yz zz of the covariance in the world."""
    if covars is None:
        _, _, m = rotation(table, place)
        a, b, c = (
            row_of(table, SHAPE + 4, place),
            row_of(table, SHAPE + 5, place),
            row_of(table, SHAPE + 6, place),
        )
        a, b, c = a * a, b * b, c * c
        return (
            a * m[0] * m[0] + b * m[1] * m[1] + c * m[2] * m[2],
            a * m[0] * m[3] + b * m[1] * m[4] + c * m[2] * m[5],
            a * m[0] * m[6] + b * m[1] * m[7] + c * m[2] * m[8],
            a * m[3] * m[3] + b * m[4] * m[4] + c * m[5] * m[5],
            a * m[3] * m[6] + b * m[4] * m[7] + c * m[5] * m[8],
            a * m[6] * m[6] + b * m[7] * m[7] + c * m[8] * m[8],
        )
    return (
        row_of(table, SHAPE, place), row_of(table, SHAPE + 1, place), row_of(table, SHAPE + 2, place),
        row_of(table, SHAPE + 3, place), row_of(table, SHAPE + 4, place), row_of(table, SHAPE + 5, place),
    )  # fmt: skip


@inlined
def to_camera(table, place, camera):
    """Camera coordinates X Y Z of the means."""
    x, y, z = row_of(table, MEAN, place), row_of(table, MEAN + 1, place), row_of(table, MEAN + 2, place)
    return (
        x * camera[0] + y * camera[1] + z * camera[2] + camera[9],
        x * camera[3] + y * camera[4] + z * camera[5] + camera[10],
        x * camera[6] + y * camera[7] + z * camera[8] + camera[11],
    )


@inlined
def product(covariance, vector):
    """Symmetric 3 x 3 (six entries) times a vector."""
    xx, xy, xz, yy, yz, zz = covariance
    a, b, c = vector
    return a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz


@inlined
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def planar_rows(camera, inverse_z, u, v):
    """The two rows of J W: how a step in the world moves the projection."""
    scale_x, scale_y = inverse_z * camera[FX], inverse_z * camera[FY]
    row_x = (
        scale_x * (camera[0] - u * camera[6]),
        scale_x * (camera[1] - u * camera[7]),
        scale_x * (camera[2] - u * camera[8]),
    )
    row_y = (
        scale_y * (camera[3] - v * camera[6]),
        scale_y * (camera[4] - v * camera[7]),
        scale_y * (camera[5] - v * camera[8]),
    )
    return row_x, row_y


@inlined
def narrow(xx, xy, yy):
    """Limit the off-diagonal entry to what a covariance can have; also whether it was within."""
    limit = root(xx * yy)
    within = (xy <= limit) & (xy >= 0.0 - limit)
    return minimum(maximum(xy, 0.0 - limit), limit), within


@inlined
def blurred(sharp, trace, eps2d):
    """Determinant of a covariance + eps2d I, from that of the covariance: nothing cancels."""
    return sharp + (trace + eps2d) * eps2d


@inlined
def split_center(center):
    """A coordinate in px as a whole number that float32 holds, and what is missing."""
    center = minimum(maximum(center, -1e30), 1e30)
    whole = to_single(floor(center))
    return whole, center - whole

"""Projection of Gaussians, forward and backward, eight at a time in float64.

Doubles, because needles (one axis ten thousand times the other) lose all digits of their 2-D determinant in
float32, and because a vector of doubles costs little beside the memory traffic. Each group of Gaussians is
transposed into a table (one row per quantity) that stays in L1; the mathematics then runs along the rows.
Formulas: Zwicker et al. 2001 (EWA splatting); the names are those of `reference.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.lanes import (
    at,
    bank,
    floor,
    fma,
    get,
    length,
    load,
    magnitude,
    maximum,
    minimum,
    put,
    root,
    set_at,
    split_exponent,
    spread,
    store,
    take,
    to_single,
    total,
    where,
)
from stages.shared.splat.kernels.layout import (
    COLOR,
    DEPTH,
    GROUP,
    GROUPS_PER_TURN,
    LOG_OPACITY,
    SUM_COLOR,
    SUM_DEPTH,
    SUM_H,
    SUM_HU,
    SUM_HUX,
    SUM_HUY,
    SUM_HV,
    SUM_HVY,
    TILE_SHIFT,
    U0,
    UX,
    UY,
    V0,
    VY,
    WHOLE_X,
    WHOLE_Y,
)
from stages.shared.splat.settings import ALPHA_MIN, SHORTEST_QUATERNION

# mypy: ignore-errors
# (compiled and type-checked by numba)

# A camera is 24 doubles: R (9), t (3), fx fy cx cy, limits of x/z and y/z (4), near, far, eps2d, antialiased.
R, T, FX, FY, CX, CY, LEFT, RIGHT, TOP, BOTTOM, NEAR, FAR, EPS2D, ANTIALIASED = (
    0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23,
)  # fmt: skip
CAMERA_LENGTH = 24
CAMERA_GRADIENTS = 16
"""Gradients of R, t and fx fy cx cy come back in this order."""

LARGEST = 1e38
"""Gradients stay within this, inside the range of float32."""
REFUSED = np.int32(-1)
"""In `counts`: the Gaussian's numbers cannot be rendered."""

WIDE = 8
_LANES = (0,) * WIDE
HALF_LOG2E = 0.5 * math.log2(math.e)
_LOG2_CUT = math.log2(ALPHA_MIN)
_MARGIN = 1e-3
"""px added to every side of the box, for the rounding of records to float32."""

# Rows of the table. Input, then (forward) output.
_MEAN, _SHAPE, _OPACITY = 0, 3, 10
_OUT = 11
_RECORD = COLOR
"""A record's fields before the colours, in its order."""
_O_LEFT, _O_TOP, _O_RIGHT, _O_BOTTOM = range(_OUT + _RECORD, _OUT + _RECORD + 4)
_FORWARD_ROWS = _OUT + _RECORD + 4
# Backward: sums of the slots, then the gradients.
_SUMS = 11
_G_MEAN = _SUMS + SUM_COLOR
_G_SHAPE = _G_MEAN + 3
_G_OPACITY = _G_SHAPE + 7
_BACKWARD_ROWS = _G_OPACITY + 1


@inlined
def _row(table, row, place):
    return load(table, row * GROUP + place, _LANES)


@inlined
def _set(table, row, place, value):
    store(table, row * GROUP + place, value)


@inlined
def _set_gradient(table, row, place, value):
    """Saturating: a Gaussian of 1e18 m can have gradients beyond float32. (Not a number stays what it is.)"""
    store(
        table, row * GROUP + place, where(value > LARGEST, LARGEST, where(value < -LARGEST, -LARGEST, value))
    )


@inlined
def _log2(a):
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
def _gather(table, group, count, means, quats, scales, covars, opacities):
    """Transpose `count` Gaussians into the table; the last one fills up the rest of the group."""
    for j in range(GROUP):
        g = group + min(j, count - 1)
        for k in range(3):
            set_at(table, (_MEAN + k) * GROUP + j, np.float64(at(means, 3 * g + k)))
        # Two tests, not one with an else: what is None is then left out when compiling.
        if quats is not None:
            for k in range(4):
                set_at(table, (_SHAPE + k) * GROUP + j, np.float64(at(quats, 4 * g + k)))
            for k in range(3):
                set_at(table, (_SHAPE + 4 + k) * GROUP + j, np.float64(at(scales, 3 * g + k)))
        if covars is not None:
            place = _SHAPE * GROUP + j
            for row in range(3):
                for column in range(row, 3):
                    upper, lower = at(covars, 9 * g + 3 * row + column), at(covars, 9 * g + 3 * column + row)
                    set_at(table, place, 0.5 * (np.float64(upper) + np.float64(lower)))
                    place += GROUP
        set_at(table, _OPACITY * GROUP + j, np.float64(at(opacities, g)))


@inlined
def _rotation(table, place):
    """Unit quaternion (w x y z), 1 / length of the given one, and the nine entries of its matrix."""
    w, x, y, z = (
        _row(table, _SHAPE, place),
        _row(table, _SHAPE + 1, place),
        _row(table, _SHAPE + 2, place),
        _row(table, _SHAPE + 3, place),
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
def _covariance(table, place, covars):
    """Entries xx xy xz yy yz zz of the covariance in the world."""
    if covars is None:
        _, _, m = _rotation(table, place)
        a, b, c = (
            _row(table, _SHAPE + 4, place),
            _row(table, _SHAPE + 5, place),
            _row(table, _SHAPE + 6, place),
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
        _row(table, _SHAPE, place), _row(table, _SHAPE + 1, place), _row(table, _SHAPE + 2, place),
        _row(table, _SHAPE + 3, place), _row(table, _SHAPE + 4, place), _row(table, _SHAPE + 5, place),
    )  # fmt: skip


@inlined
def _to_camera(table, place, camera):
    """Camera coordinates X Y Z of the means."""
    x, y, z = _row(table, _MEAN, place), _row(table, _MEAN + 1, place), _row(table, _MEAN + 2, place)
    return (
        x * camera[0] + y * camera[1] + z * camera[2] + camera[9],
        x * camera[3] + y * camera[4] + z * camera[5] + camera[10],
        x * camera[6] + y * camera[7] + z * camera[8] + camera[11],
    )


@inlined
def _product(covariance, vector):
    """Symmetric 3 x 3 (six entries) times a vector."""
    xx, xy, xz, yy, yz, zz = covariance
    a, b, c = vector
    return a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _planar_rows(camera, inverse_z, u, v):
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
def _narrow(xx, xy, yy):
    """Limit the off-diagonal entry to what a covariance can have; also whether it was within."""
    limit = root(xx * yy)
    within = (xy <= limit) & (xy >= 0.0 - limit)
    return minimum(maximum(xy, 0.0 - limit), limit), within


@inlined
def _blurred(sharp, trace, eps2d):
    """Determinant of a covariance + eps2d I, from that of the covariance: nothing cancels."""
    return sharp + (trace + eps2d) * eps2d


@inlined
def _split(center):
    """A coordinate in px as a whole number that float32 holds, and what is missing."""
    center = minimum(maximum(center, -1e30), 1e30)
    whole = to_single(floor(center))
    return whole, center - whole


@inlined
def _acceptable(table, place, covars):
    """False for numbers that `scene.check_gaussians` refuses: it then finds out which and why."""
    everything = _row(table, _OPACITY, place)
    for k in range(3):
        everything = everything + _row(table, _MEAN + k, place)
    for k in range(7 if covars is None else 6):
        everything = everything + _row(table, _SHAPE + k, place)
    opacity = _row(table, _OPACITY, place)
    # Zero times a sum of float32 is zero, unless one of them is infinite or not a number.
    fine = (everything * 0.0 >= 0.0) & (opacity >= 0.0) & (opacity <= 1.0)
    if covars is None:
        w, x = magnitude(_row(table, _SHAPE, place)), magnitude(_row(table, _SHAPE + 1, place))
        y, z = magnitude(_row(table, _SHAPE + 2, place)), magnitude(_row(table, _SHAPE + 3, place))
        return fine & (maximum(maximum(w, x), maximum(y, z)) >= SHORTEST_QUATERNION)
    xx, yy, zz = _row(table, _SHAPE, place), _row(table, _SHAPE + 3, place), _row(table, _SHAPE + 5, place)
    return fine & (minimum(minimum(xx, yy), zz) >= 0.0)


@kernel
def project(
    turn, means, quats, scales, covars, opacities, colors, channels, camera, width, height,
    records, stride, boxes, depths, counts,
):  # fmt: skip
    """Gaussians -> records, boxes (4N,) uint16 px inclusive, depths (N,) m, counts (N,) of tiles.

    A count is 0 if the Gaussian is unseen, REFUSED if it cannot be rendered. All arrays are flat. Either
    quats (4N,) and scales (3N,), or covars (9N,); the others None.
    """
    n = len(opacities)
    table = np.empty(_FORWARD_ROWS * GROUP, np.float64)
    per_turn = GROUP * GROUPS_PER_TURN
    while True:
        begin = take(turn) * per_turn
        if begin >= n:
            break
        for group in range(begin, min(begin + per_turn, n), GROUP):
            count = min(GROUP, n - group)
            _gather(table, group, count, means, quats, scales, covars, opacities)
            for place in range(0, GROUP, WIDE):
                _project_lanes(table, place, camera, covars, width, height)
            for j in range(count):
                g = group + j
                left, right = at(table, _O_LEFT * GROUP + j), at(table, _O_RIGHT * GROUP + j)
                if not left <= right:
                    set_at(counts, g, np.int32(0) if left < 2.0 else REFUSED)
                    continue
                top, bottom = at(table, _O_TOP * GROUP + j), at(table, _O_BOTTOM * GROUP + j)
                record = g * stride
                for k in range(_RECORD):
                    set_at(records, record + k, np.float32(at(table, (_OUT + k) * GROUP + j)))
                set_at(depths, g, at(records, record + DEPTH))
                for c in range(channels):
                    set_at(records, record + COLOR + c, at(colors, g * channels + c))
                left, top, right, bottom = int(left), int(top), int(right), int(bottom)
                set_at(boxes, 4 * g, np.uint16(left))
                set_at(boxes, 4 * g + 1, np.uint16(top))
                set_at(boxes, 4 * g + 2, np.uint16(right))
                set_at(boxes, 4 * g + 3, np.uint16(bottom))
                across = (right >> TILE_SHIFT) - (left >> TILE_SHIFT) + 1
                set_at(counts, g, np.int32(across * ((bottom >> TILE_SHIFT) - (top >> TILE_SHIFT) + 1)))


@inlined
def _project_lanes(table, place, camera, covars, width, height):
    x, y, z = _to_camera(table, place, camera)
    inside = (z > camera[NEAR]) & (z < camera[FAR])
    inverse_z = 1.0 / where(inside, z, 1.0)
    u, v = x * inverse_z, y * inverse_z
    center_x, center_y = u * camera[FX] + camera[CX], v * camera[FY] + camera[CY]
    u = minimum(maximum(u, camera[LEFT]), camera[RIGHT])
    v = minimum(maximum(v, camera[TOP]), camera[BOTTOM])
    row_x, row_y = _planar_rows(camera, inverse_z, u, v)
    covariance = _covariance(table, place, covars)
    through_x, through_y = _product(covariance, row_x), _product(covariance, row_y)
    sharp_xx, sharp_yy = maximum(_dot(row_x, through_x), 0.0), maximum(_dot(row_y, through_y), 0.0)
    xy, _ = _narrow(sharp_xx, _dot(row_x, through_y), sharp_yy)
    xx, yy = sharp_xx + camera[EPS2D], sharp_yy + camera[EPS2D]
    sharp = maximum(sharp_xx * sharp_yy - xy * xy, 0.0)
    determinant = _blurred(sharp, sharp_xx + sharp_yy, camera[EPS2D])
    opacity = _row(table, _OPACITY, place)
    if camera[ANTIALIASED] > 0:
        opacity = opacity * root(sharp / determinant)
    log_opacity = _log2(maximum(opacity, 1e-30))
    # u^2 + v^2 <= reach is the ellipse on which alpha falls to the cut.
    reach = log_opacity - _LOG2_CUT
    sides = maximum(reach, 0.0) * (1.0 / HALF_LOG2E)
    across, down = root(sides * xx) + _MARGIN, root(sides * yy) + _MARGIN
    left = maximum(0.0 - floor(0.0 - (center_x - across - 0.5)), 0.0)
    right = minimum(floor(center_x + across - 0.5), width - 1.0)
    top = maximum(0.0 - floor(0.0 - (center_y - down - 0.5)), 0.0)
    bottom = minimum(floor(center_y + down - 0.5), height - 1.0)
    seen = inside & (reach >= 0.0) & (left <= right) & (top <= bottom)
    whole_x, rest_x = _split(center_x)
    whole_y, rest_y = _split(center_y)
    _set(table, _OUT + WHOLE_X, place, whole_x)
    _set(table, _OUT + WHOLE_Y, place, whole_y)
    shared = root(HALF_LOG2E / (determinant * yy))
    ux, u_y, vy = yy * shared, 0.0 - xy * shared, root(HALF_LOG2E / yy)
    _set(table, _OUT + UX, place, ux)
    _set(table, _OUT + UY, place, u_y)
    _set(table, _OUT + U0, place, 0.0 - ux * rest_x - u_y * rest_y)
    _set(table, _OUT + VY, place, vy)
    _set(table, _OUT + V0, place, 0.0 - vy * rest_y)
    _set(table, _OUT + LOG_OPACITY, place, log_opacity)
    _set(table, _OUT + DEPTH, place, z)
    # left > right says unseen; left = 2 as well, refused.
    fine = _acceptable(table, place, covars)
    _set(table, _O_LEFT, place, where(fine, where(seen, left, 1.0), 2.0))
    _set(table, _O_RIGHT, place, where(fine & seen, right, 0.0))
    _set(table, _O_TOP, place, top)
    _set(table, _O_BOTTOM, place, bottom)


@kernel
def project_backward(
    turn, means, quats, scales, covars, opacities, camera, counts, first_slots, sums, lanes, slot,
    channels, add, g_means, g_quats, g_scales, g_covars, g_opacities, g_colors, g_camera,
):  # fmt: skip
    """Sum every Gaussian's slots, in order of its tiles, and carry the sums back to the inputs.

    All arrays are flat. add: add to the gradients (second camera and later) instead of writing them. g_camera
    (turns * 16,): each turn's share of the camera's gradients, to be summed in order by the caller.
    """
    n = len(opacities)
    parts = length(slot) // len(lanes)
    table = np.zeros(_BACKWARD_ROWS * GROUP, np.float64)
    collected = np.empty(GROUP * length(slot), np.float32)
    whole = bank(slot, np.empty(length(slot), np.float32), lanes)
    of_camera = np.empty(CAMERA_GRADIENTS * WIDE, np.float64)
    per_turn = GROUP * GROUPS_PER_TURN
    while True:
        mine = take(turn)
        begin = mine * per_turn
        if begin >= n:
            break
        of_camera[:] = 0.0
        for group in range(begin, min(begin + per_turn, n), GROUP):
            count = min(GROUP, n - group)
            any_seen = False
            for j in range(count):
                g = group + j
                any_seen |= at(counts, g) > 0
                for k in range(parts):
                    put(whole, k, spread(np.float32(0.0), lanes))
                first, last = np.int64(at(first_slots, g)), np.int64(at(first_slots, g + 1))
                for place in range(first * length(slot), last * length(slot), length(slot)):
                    for k in range(parts):
                        put(whole, k, get(whole, k) + load(sums, place + k * len(lanes), lanes))
                for k in range(parts):
                    store(collected, j * length(slot) + k * len(lanes), get(whole, k))
            for j in range(count):
                g, place = group + j, j * length(slot)
                for k in range(SUM_COLOR):
                    set_at(table, (_SUMS + k) * GROUP + j, np.float64(at(collected, place + k)))
                for c in range(channels):
                    _give(g_colors, g * channels + c, at(collected, place + SUM_COLOR + c), add)
            if any_seen:
                _gather(table, group, count, means, quats, scales, covars, opacities)
                for k in range(SUM_COLOR):
                    for j in range(count, GROUP):
                        set_at(table, (_SUMS + k) * GROUP + j, 0.0)
                for place in range(0, GROUP, WIDE):
                    _project_lanes_backward(table, place, camera, covars, of_camera)
            elif not add:
                table[_G_MEAN * GROUP :] = 0.0
            if any_seen or not add:
                _scatter(table, group, count, add, g_means, g_quats, g_scales, g_covars, g_opacities)
        for k in range(CAMERA_GRADIENTS):
            g_camera[mine * CAMERA_GRADIENTS + k] = total(load(of_camera, k * WIDE, _LANES))


@inlined
def _give(array, index, value, add):
    """Write a gradient, or add it."""
    set_at(array, index, at(array, index) + value if add else value)


@inlined
def _scatter(table, group, count, add, g_means, g_quats, g_scales, g_covars, g_opacities):
    """The table's gradients to their rows; a covariance's in full, symmetric."""
    for j in range(count):
        g = group + j
        for k in range(3):
            _give(g_means, 3 * g + k, np.float32(at(table, (_G_MEAN + k) * GROUP + j)), add)
        if g_quats is not None:
            for k in range(4):
                _give(g_quats, 4 * g + k, np.float32(at(table, (_G_SHAPE + k) * GROUP + j)), add)
            for k in range(3):
                _give(g_scales, 3 * g + k, np.float32(at(table, (_G_SHAPE + 4 + k) * GROUP + j)), add)
        if g_covars is not None:
            place = _G_SHAPE * GROUP + j
            for row in range(3):
                for column in range(row, 3):
                    value = np.float32(at(table, place))
                    _give(g_covars, 9 * g + 3 * row + column, value, add)
                    if row != column:
                        _give(g_covars, 9 * g + 3 * column + row, value, add)
                    place += GROUP
        _give(g_opacities, g, np.float32(at(table, _G_OPACITY * GROUP + j)), add)


@inlined
def _more(of_camera, k, value):
    store(of_camera, k * WIDE, load(of_camera, k * WIDE, _LANES) + value)


@inlined
def _project_lanes_backward(table, place, camera, covars, of_camera):
    # Forward again, as far as needed.
    x, y, z = _to_camera(table, place, camera)
    inside = (z > camera[NEAR]) & (z < camera[FAR])
    inverse_z = 1.0 / where(inside, z, 1.0)
    raw_u, raw_v = x * inverse_z, y * inverse_z
    u = minimum(maximum(raw_u, camera[LEFT]), camera[RIGHT])
    v = minimum(maximum(raw_v, camera[TOP]), camera[BOTTOM])
    row_x, row_y = _planar_rows(camera, inverse_z, u, v)
    covariance = _covariance(table, place, covars)
    through_x, through_y = _product(covariance, row_x), _product(covariance, row_y)
    sharp_xx, sharp_yy = maximum(_dot(row_x, through_x), 0.0), maximum(_dot(row_y, through_y), 0.0)
    xy, within = _narrow(sharp_xx, _dot(row_x, through_y), sharp_yy)
    xx, yy = sharp_xx + camera[EPS2D], sharp_yy + camera[EPS2D]
    sharp = maximum(sharp_xx * sharp_yy - xy * xy, 0.0)
    inverse_det = 1.0 / _blurred(sharp, sharp_xx + sharp_yy, camera[EPS2D])
    shared = root(inverse_det * HALF_LOG2E / yy)
    ux, u_y, vy = yy * shared, 0.0 - xy * shared, root(HALF_LOG2E / yy)

    # Sums over pixels -> centre and 2-D covariance. ln 2 because alpha = 2^(...).
    ln2 = math.log(2.0)
    sum_h = _row(table, _SUMS + SUM_H, place)
    sum_hu, sum_hv = _row(table, _SUMS + SUM_HU, place), _row(table, _SUMS + SUM_HV, place)
    _, rest_x = _split(raw_u * camera[FX] + camera[CX])
    _, rest_y = _split(raw_v * camera[FY] + camera[CY])
    g_center_x = sum_hu * ux * (2.0 * ln2)
    g_center_y = (sum_hu * u_y + sum_hv * vy) * (2.0 * ln2)
    g_ux = (_row(table, _SUMS + SUM_HUX, place) - sum_hu * rest_x) * (-2.0 * ln2)
    g_uy = (_row(table, _SUMS + SUM_HUY, place) - sum_hu * rest_y) * (-2.0 * ln2)
    g_vy = (_row(table, _SUMS + SUM_HVY, place) - sum_hv * rest_y) * (-2.0 * ln2)
    # u's coefficients are ux = sqrt(k yy / det), uy = -xy sqrt(k / (yy det)); v's is vy = sqrt(k / yy).
    along = g_ux * ux + g_uy * u_y
    g_xx = along * yy * inverse_det * -0.5
    g_xy = along * xy * inverse_det - g_uy * shared
    g_yy = (
        g_ux * ux * xy * xy * inverse_det * -0.5 / yy
        - g_uy * u_y * 0.5 * (1.0 / yy + xx * inverse_det)
        - g_vy * vy * 0.5 / yy
    )
    if camera[ANTIALIASED] > 0:
        inverse_sharp = where(sharp > 0.0, 1.0 / maximum(sharp, 1e-300), 0.0)
        half = sum_h * 0.5
        g_xx = g_xx + half * (sharp_yy * inverse_sharp - yy * inverse_det)
        g_yy = g_yy + half * (sharp_xx * inverse_sharp - xx * inverse_det)
        g_xy = g_xy - sum_h * xy * (inverse_sharp - inverse_det)
    g_xy = where(within, g_xy, 0.0)
    opacity = _row(table, _OPACITY, place)
    _set_gradient(table, _G_OPACITY, place, where(opacity > 0.0, sum_h / maximum(opacity, 1e-30), 0.0))

    # 2-D covariance = (rows of J W) V (rows)^T -> V, and the rows.
    g_row_x = (
        2.0 * g_xx * through_x[0] + g_xy * through_y[0],
        2.0 * g_xx * through_x[1] + g_xy * through_y[1],
        2.0 * g_xx * through_x[2] + g_xy * through_y[2],
    )
    g_row_y = (
        2.0 * g_yy * through_y[0] + g_xy * through_x[0],
        2.0 * g_yy * through_y[1] + g_xy * through_x[1],
        2.0 * g_yy * through_y[2] + g_xy * through_x[2],
    )
    half_xy = g_xy * 0.5
    cross_x = (
        g_xx * row_x[0] + half_xy * row_y[0],
        g_xx * row_x[1] + half_xy * row_y[1],
        g_xx * row_x[2] + half_xy * row_y[2],
    )
    cross_y = (
        half_xy * row_x[0] + g_yy * row_y[0],
        half_xy * row_x[1] + g_yy * row_y[1],
        half_xy * row_x[2] + g_yy * row_y[2],
    )
    g_covariance = (
        row_x[0] * cross_x[0] + row_y[0] * cross_y[0],
        row_x[0] * cross_x[1] + row_y[0] * cross_y[1],
        row_x[0] * cross_x[2] + row_y[0] * cross_y[2],
        row_x[1] * cross_x[1] + row_y[1] * cross_y[1],
        row_x[1] * cross_x[2] + row_y[1] * cross_y[2],
        row_x[2] * cross_x[2] + row_y[2] * cross_y[2],
    )
    _shape_backward(table, place, covars, g_covariance)

    # Rows of J W = f / z (R_x - u R_z): -> u, v, 1 / z; centre = f x / z + c: -> x, y, 1 / z.
    fx, fy = camera[FX], camera[FY]
    depth_axis = (camera[6], camera[7], camera[8])
    unscaled_x = (camera[0] - u * camera[6], camera[1] - u * camera[7], camera[2] - u * camera[8])
    unscaled_y = (camera[3] - v * camera[6], camera[4] - v * camera[7], camera[5] - v * camera[8])
    g_scale_x, g_scale_y = _dot(g_row_x, unscaled_x), _dot(g_row_y, unscaled_y)
    g_u = 0.0 - inverse_z * fx * _dot(g_row_x, depth_axis)
    g_v = 0.0 - inverse_z * fy * _dot(g_row_y, depth_axis)
    g_u = where((raw_u >= camera[LEFT]) & (raw_u <= camera[RIGHT]), g_u, 0.0) + g_center_x * fx
    g_v = where((raw_v >= camera[TOP]) & (raw_v <= camera[BOTTOM]), g_v, 0.0) + g_center_y * fy
    g_inverse_z = g_scale_x * fx + g_scale_y * fy + g_u * x + g_v * y
    g_x, g_y = g_u * inverse_z, g_v * inverse_z
    g_z = _row(table, _SUMS + SUM_DEPTH, place) - g_inverse_z * inverse_z * inverse_z
    for k in range(3):
        _set_gradient(table, _G_MEAN + k, place, g_x * camera[k] + g_y * camera[3 + k] + g_z * camera[6 + k])

    # The camera: points = R means + t, and R once more in the rows.
    scale_x, scale_y = inverse_z * fx, inverse_z * fy
    for k in range(3):
        mean = _row(table, _MEAN + k, place)
        g_x_k, g_y_k = g_row_x[k] * scale_x, g_row_y[k] * scale_y
        _more(of_camera, k, g_x * mean + g_x_k)
        _more(of_camera, 3 + k, g_y * mean + g_y_k)
        _more(of_camera, 6 + k, g_z * mean - g_x_k * u - g_y_k * v)
    _more(of_camera, 9, g_x)
    _more(of_camera, 10, g_y)
    _more(of_camera, 11, g_z)
    _more(of_camera, 12, g_center_x * raw_u + g_scale_x * inverse_z)
    _more(of_camera, 13, g_center_y * raw_v + g_scale_y * inverse_z)
    _more(of_camera, 14, g_center_x)
    _more(of_camera, 15, g_center_y)


@inlined
def _shape_backward(table, place, covars, g_covariance):
    """Covariance -> scales and quaternion: V = M S^2 M^T, M the rotation of q / |q|."""
    if covars is not None:
        for k in range(6):
            _set_gradient(table, _G_SHAPE + k, place, g_covariance[k])
    else:
        (w, x, y, z), inverse, m = _rotation(table, place)
        first = _product(g_covariance, (m[0], m[3], m[6]))
        second = _product(g_covariance, (m[1], m[4], m[7]))
        third = _product(g_covariance, (m[2], m[5], m[8]))
        a, b, c = (
            _row(table, _SHAPE + 4, place),
            _row(table, _SHAPE + 5, place),
            _row(table, _SHAPE + 6, place),
        )
        _set_gradient(table, _G_SHAPE + 4, place, 2.0 * a * _dot(first, (m[0], m[3], m[6])))
        _set_gradient(table, _G_SHAPE + 5, place, 2.0 * b * _dot(second, (m[1], m[4], m[7])))
        _set_gradient(table, _G_SHAPE + 6, place, 2.0 * c * _dot(third, (m[2], m[5], m[8])))
        a, b, c = 2.0 * a * a, 2.0 * b * b, 2.0 * c * c
        g00, g10, g20 = first[0] * a, first[1] * a, first[2] * a
        g01, g11, g21 = second[0] * b, second[1] * b, second[2] * b
        g02, g12, g22 = third[0] * c, third[1] * c, third[2] * c
        gw = 2.0 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
        gx = 2.0 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2.0 * x * (g11 + g22))
        gy = 2.0 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2.0 * y * (g00 + g22))
        gz = 2.0 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2.0 * z * (g00 + g11))
        along = gw * w + gx * x + gy * y + gz * z
        _set_gradient(table, _G_SHAPE, place, (gw - along * w) * inverse)
        _set_gradient(table, _G_SHAPE + 1, place, (gx - along * x) * inverse)
        _set_gradient(table, _G_SHAPE + 2, place, (gy - along * y) * inverse)
        _set_gradient(table, _G_SHAPE + 3, place, (gz - along * z) * inverse)

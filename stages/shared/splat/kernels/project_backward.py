"""Projection backward: sums of the gradient slots -> gradients of the inputs and of the camera."""

from __future__ import annotations

import math

import numpy as np

from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.geometry import (
    ANTIALIASED,
    BOTTOM,
    CX,
    CY,
    EIGHT,
    EPS2D,
    FAR,
    FIRST_FREE,
    FX,
    FY,
    HALF_LOG2E,
    LEFT,
    MEAN,
    NEAR,
    OPACITY,
    RIGHT,
    SHAPE,
    TOP,
    WIDE,
    blurred,
    covariance_of,
    dot,
    gather,
    narrow,
    planar_rows,
    product,
    rotation,
    row_of,
    split_center,
    to_camera,
)
from stages.shared.splat.kernels.layout import (
    GROUP,
    GROUPS_PER_TURN,
    SUM_COLOR,
    SUM_DEPTH,
    SUM_H,
    SUM_HU,
    SUM_HUX,
    SUM_HUY,
    SUM_HV,
    SUM_HVY,
)
from stages.shared.splat.kernels.memory import (
    at,
    get,
    length,
    load,
    next_item,
    put,
    register_tile,
    set_at,
    store,
)
from stages.shared.splat.kernels.simd import maximum, minimum, root, total, where

# mypy: ignore-errors
# (compiled and type-checked by numba)

CAMERA_GRADIENTS = 16
"""Gradients of R, t and fx fy cx cy come back in this order."""

LARGEST = 1e38
"""Gradients stay within this, inside the range of float32."""

# Rows of the table after the inputs: sums of the slots, then the gradients.
_SUMS = FIRST_FREE
_G_MEAN = _SUMS + SUM_COLOR
_G_SHAPE = _G_MEAN + 3
_G_OPACITY = _G_SHAPE + 7
_BACKWARD_ROWS = _G_OPACITY + 1


@kernel
def project_backward(
    counter, means, quats, scales, covars, opacities, camera, counts, first_slots, sums, lanes, slot,
    channels, add, g_means, g_quats, g_scales, g_covars, g_opacities, g_colors, g_camera,
):  # fmt: skip
    """Sum every Gaussian's slots, in order of its tiles, and carry the sums back to the inputs.

    All arrays are flat. add: add to the gradients (second camera and later) instead of writing them. g_camera
    (turns * 16,): each turn's share of the camera's gradients, to be summed in order by the caller.
    """
    n = len(opacities)
    parts = length(slot) // len(lanes)
    table = np.zeros(_BACKWARD_ROWS * GROUP, np.float64)
    collected = np.empty(GROUP * length(slot), sums.dtype)
    whole = register_tile(slot, np.empty(length(slot), sums.dtype), lanes)
    zero = load(np.zeros(len(lanes), sums.dtype), 0, lanes)
    of_camera = np.empty(CAMERA_GRADIENTS * WIDE, np.float64)
    per_turn = GROUP * GROUPS_PER_TURN
    while True:
        mine = next_item(counter)
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
                    put(whole, k, zero)
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
                    _write(g_colors, g * channels + c, at(collected, place + SUM_COLOR + c), add)
            if any_seen:
                gather(table, group, count, means, quats, scales, covars, opacities)
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
            g_camera[mine * CAMERA_GRADIENTS + k] = total(load(of_camera, k * WIDE, EIGHT))


@inlined
def _write(array, index, value, add):
    """Write a gradient, or add it."""
    set_at(array, index, at(array, index) + value if add else value)


@inlined
def _scatter(table, group, count, add, g_means, g_quats, g_scales, g_covars, g_opacities):
    """The table's gradients to their rows; a covariance's in full, symmetric."""
    for j in range(count):
        g = group + j
        for k in range(3):
            _write(g_means, 3 * g + k, at(table, (_G_MEAN + k) * GROUP + j), add)
        if g_quats is not None:
            for k in range(4):
                _write(g_quats, 4 * g + k, at(table, (_G_SHAPE + k) * GROUP + j), add)
            for k in range(3):
                _write(g_scales, 3 * g + k, at(table, (_G_SHAPE + 4 + k) * GROUP + j), add)
        if g_covars is not None:
            place = _G_SHAPE * GROUP + j
            for row in range(3):
                for column in range(row, 3):
                    value = at(table, place)
                    _write(g_covars, 9 * g + 3 * row + column, value, add)
                    if row != column:
                        _write(g_covars, 9 * g + 3 * column + row, value, add)
                    place += GROUP
        _write(g_opacities, g, at(table, _G_OPACITY * GROUP + j), add)


@inlined
def _accumulate(of_camera, k, value):
    store(of_camera, k * WIDE, load(of_camera, k * WIDE, EIGHT) + value)


@inlined
def _set_gradient(table, row, place, value):
    """Saturating: a Gaussian of 1e18 m can have gradients beyond float32. (Not a number stays what it is.)"""
    store(
        table, row * GROUP + place, where(value > LARGEST, LARGEST, where(value < -LARGEST, -LARGEST, value))
    )


@inlined
def _project_lanes_backward(table, place, camera, covars, of_camera):
    # Forward again, as far as needed.
    x, y, z = to_camera(table, place, camera)
    inside = (z > camera[NEAR]) & (z < camera[FAR])
    inverse_z = 1.0 / where(inside, z, 1.0)
    raw_u, raw_v = x * inverse_z, y * inverse_z
    u = minimum(maximum(raw_u, camera[LEFT]), camera[RIGHT])
    v = minimum(maximum(raw_v, camera[TOP]), camera[BOTTOM])
    row_x, row_y = planar_rows(camera, inverse_z, u, v)
    covariance = covariance_of(table, place, covars)
    through_x, through_y = product(covariance, row_x), product(covariance, row_y)
    sharp_xx, sharp_yy = maximum(dot(row_x, through_x), 0.0), maximum(dot(row_y, through_y), 0.0)
    xy, within = narrow(sharp_xx, dot(row_x, through_y), sharp_yy)
    xx, yy = sharp_xx + camera[EPS2D], sharp_yy + camera[EPS2D]
    sharp = maximum(sharp_xx * sharp_yy - xy * xy, 0.0)
    inverse_det = 1.0 / blurred(sharp, sharp_xx + sharp_yy, camera[EPS2D])
    shared = root(inverse_det * HALF_LOG2E / yy)
    ux, u_y, vy = yy * shared, 0.0 - xy * shared, root(HALF_LOG2E / yy)

    # Sums over pixels -> centre and 2-D covariance. ln 2 because alpha = 2^(...).
    ln2 = math.log(2.0)
    sum_h = row_of(table, _SUMS + SUM_H, place)
    sum_hu, sum_hv = row_of(table, _SUMS + SUM_HU, place), row_of(table, _SUMS + SUM_HV, place)
    _, rest_x = split_center(raw_u * camera[FX] + camera[CX])
    _, rest_y = split_center(raw_v * camera[FY] + camera[CY])
    g_center_x = sum_hu * ux * (2.0 * ln2)
    g_center_y = (sum_hu * u_y + sum_hv * vy) * (2.0 * ln2)
    g_ux = (row_of(table, _SUMS + SUM_HUX, place) - sum_hu * rest_x) * (-2.0 * ln2)
    g_uy = (row_of(table, _SUMS + SUM_HUY, place) - sum_hu * rest_y) * (-2.0 * ln2)
    g_vy = (row_of(table, _SUMS + SUM_HVY, place) - sum_hv * rest_y) * (-2.0 * ln2)
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
    opacity = row_of(table, OPACITY, place)
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
    g_scale_x, g_scale_y = dot(g_row_x, unscaled_x), dot(g_row_y, unscaled_y)
    g_u = 0.0 - inverse_z * fx * dot(g_row_x, depth_axis)
    g_v = 0.0 - inverse_z * fy * dot(g_row_y, depth_axis)
    g_u = where((raw_u >= camera[LEFT]) & (raw_u <= camera[RIGHT]), g_u, 0.0) + g_center_x * fx
    g_v = where((raw_v >= camera[TOP]) & (raw_v <= camera[BOTTOM]), g_v, 0.0) + g_center_y * fy
    g_inverse_z = g_scale_x * fx + g_scale_y * fy + g_u * x + g_v * y
    g_x, g_y = g_u * inverse_z, g_v * inverse_z
    g_z = row_of(table, _SUMS + SUM_DEPTH, place) - g_inverse_z * inverse_z * inverse_z
    for k in range(3):
        _set_gradient(table, _G_MEAN + k, place, g_x * camera[k] + g_y * camera[3 + k] + g_z * camera[6 + k])

    # The camera: points = R means + t, and R once more in the rows.
    scale_x, scale_y = inverse_z * fx, inverse_z * fy
    for k in range(3):
        mean = row_of(table, MEAN + k, place)
        g_x_k, g_y_k = g_row_x[k] * scale_x, g_row_y[k] * scale_y
        _accumulate(of_camera, k, g_x * mean + g_x_k)
        _accumulate(of_camera, 3 + k, g_y * mean + g_y_k)
        _accumulate(of_camera, 6 + k, g_z * mean - g_x_k * u - g_y_k * v)
    _accumulate(of_camera, 9, g_x)
    _accumulate(of_camera, 10, g_y)
    _accumulate(of_camera, 11, g_z)
    _accumulate(of_camera, 12, g_center_x * raw_u + g_scale_x * inverse_z)
    _accumulate(of_camera, 13, g_center_y * raw_v + g_scale_y * inverse_z)
    _accumulate(of_camera, 14, g_center_x)
    _accumulate(of_camera, 15, g_center_y)


@inlined
def _shape_backward(table, place, covars, g_covariance):
    """Covariance -> scales and quaternion: V = M S^2 M^T, M the rotation of q / |q|."""
    if covars is not None:
        for k in range(6):
            _set_gradient(table, _G_SHAPE + k, place, g_covariance[k])
    else:
        (w, x, y, z), inverse, m = rotation(table, place)
        first = product(g_covariance, (m[0], m[3], m[6]))
        second = product(g_covariance, (m[1], m[4], m[7]))
        third = product(g_covariance, (m[2], m[5], m[8]))
        a, b, c = (
            row_of(table, SHAPE + 4, place),
            row_of(table, SHAPE + 5, place),
            row_of(table, SHAPE + 6, place),
        )
        _set_gradient(table, _G_SHAPE + 4, place, 2.0 * a * dot(first, (m[0], m[3], m[6])))
        _set_gradient(table, _G_SHAPE + 5, place, 2.0 * b * dot(second, (m[1], m[4], m[7])))
        _set_gradient(table, _G_SHAPE + 6, place, 2.0 * c * dot(third, (m[2], m[5], m[8])))
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

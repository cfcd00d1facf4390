"""Backward blending: the same walk, front to back again.

With the final picture known, what lies behind a Gaussian is the total minus what came before it, so that no
list per pixel is kept and nothing is divided to recover a transmittance. Per pixel and picture,

    d(loss)/d(alpha_k) = T_k value_k - rest_k / (1 - alpha_k),   value_k = G . c_k + g_z z_k + g_alpha,
    rest_k = total - sum_{j<=k} w_j value_j,                     total = sum_j w_j value_j,

where g_alpha includes the background (it is seen through what is left). Gradients of one entry (tile, Gaussian)
go to a slot of its own: nothing is added concurrently, and the order of additions is fixed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.shared.splat.kernels.blend import AHEAD, ALPHA_TOP, CUT, ONE, STOP, ZERO, exponent, pixel_place
from stages.shared.splat.kernels.lanes import (
    at,
    bank,
    exp2_small,
    fma,
    get,
    lane_sums,
    length,
    load,
    lowest_bit,
    magnitude,
    minimum,
    prefetch,
    put,
    spread,
    store,
    take,
    where,
)
from stages.shared.splat.kernels.layout import (
    BLOCK_WIDTH,
    BLOCKS_ACROSS,
    CENTER_X,
    CENTER_Y,
    DEPTH,
    LAYER,
    LOG_OPACITY,
    SUM_DEPTH,
    SUM_H,
    SUM_HU,
    SUM_HUX,
    SUM_HUY,
    SUM_HY,
    SUM_HYY,
    TILE,
    TILE_PIXELS,
    UX,
    UY,
    VY,
)

# mypy: disable-error-code="no-untyped-def"

# Planes of a picture's state: transmittance, rest, gradient of alpha, of depth, of colours.
_REST, _G_ALPHA, _G_DEPTH = 1, 2, 3
_PLANES = 4


@njit(forceinline=True)
def _start_tile(
    state, sets, set_size, top, left, width, height, block_height, background, features, alpha, depth, g_features,
    g_alpha, g_depth,
):  # fmt: skip
    channels = len(background)
    for picture in range(sets):
        base = picture * set_size
        for place in range(TILE_PIXELS):
            state[base + place] = -ONE
        for place in range(TILE_PIXELS, set_size):
            state[base + place] = ZERO
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                place = base + pixel_place(row - top, column - left, block_height)
                pixel = (picture * height + row) * width + column
                behind, whole = ZERO, ZERO
                for c in range(channels):
                    g = g_features[pixel * channels + c]
                    behind += g * background[c]
                    whole += g * features[pixel * channels + c]
                    state[place + (_PLANES + c) * TILE_PIXELS] = g
                of_alpha = g_alpha[pixel] - behind
                # `features` has the background in it: take it out with what it contributed.
                rest = whole - behind + alpha[pixel] * (of_alpha + behind) + depth[pixel] * g_depth[pixel]
                state[place] = ONE
                state[place + _REST * TILE_PIXELS] = rest
                state[place + _G_ALPHA * TILE_PIXELS] = of_alpha
                state[place + _G_DEPTH * TILE_PIXELS] = g_depth[pixel]


@njit(forceinline=True)
def _pull(state, plane, record, records, opaque, inverse, grads, lanes, channels):
    """One picture's part of d(loss)/d(alpha) of a block; adds depth and colour gradients to the bank."""
    before = load(state, plane, lanes)
    after = fma(ZERO - opaque, before, before)
    open_lanes = after > STOP
    weight = where(open_lanes, before * opaque, ZERO)
    store(state, plane, where(open_lanes, after, ZERO - magnitude(before)))
    value = load(state, plane + _G_ALPHA * TILE_PIXELS, lanes)
    for channel in range(length(channels) + 1):
        incoming = load(state, plane + (_G_DEPTH + channel) * TILE_PIXELS, lanes)
        value = fma(incoming, at(records, record + DEPTH + channel), value)
        put(grads, SUM_DEPTH + channel, fma(weight, incoming, get(grads, SUM_DEPTH + channel)))
    rest = fma(ZERO - weight, value, load(state, plane + _REST * TILE_PIXELS, lanes))
    store(state, plane + _REST * TILE_PIXELS, rest)
    return where(open_lanes, before * value - rest * inverse, ZERO)


@njit(nogil=True, cache=True, error_model="numpy")
def blend_backward(
    turn, starts, gaussians, blocks, records, stride, background, features, alpha, depth,
    g_features, g_alpha, g_depth, sums, width, height, layers, ramps, lanes, channels, slot,
):  # fmt: skip
    """Gradients of the tiles this thread gets: sums (E * slot length,), entry by entry (see `layout`).

    Slots of entries whose `blocks` are empty stay unwritten.
    """
    count = len(lanes)
    block_height = count // BLOCK_WIDTH
    columns = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    sets = 1 if layers is None else 1 + layers
    set_size = (_PLANES + length(channels)) * TILE_PIXELS
    state = np.empty(sets * set_size, np.float32)
    scratch = np.empty(length(slot) * count, np.float32)
    grads = bank(slot, scratch, lanes)
    lane_x, lane_y = load(ramps, 0, lanes), load(ramps, count, lanes)
    zero = spread(ZERO, lanes)
    while True:
        tile = take(turn)
        if tile >= tiles:
            break
        first, last = starts[tile], starts[tile + 1]
        if first == last:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        _start_tile(
            state, sets, set_size, top, left, width, height, block_height, background, features, alpha, depth,
            g_features, g_alpha, g_depth,
        )  # fmt: skip
        for entry in range(first, last):
            if entry + AHEAD < last:
                prefetch(records, at(gaussians, entry + AHEAD) * stride)
            todo = np.int64(at(blocks, entry))
            if todo == 0:
                continue
            record = at(gaussians, entry) * stride
            x, y = at(records, record + CENTER_X) - left, at(records, record + CENTER_Y) - top
            ux, uy = at(records, record + UX), at(records, record + UY)
            vy, log_opacity = at(records, record + VY), at(records, record + LOG_OPACITY)
            own = 0
            if layers is not None:
                own = (1 + np.int64(at(records, record + LAYER))) * set_size
            for k in range(length(slot)):
                put(grads, k, zero)
            while todo != 0:
                block = lowest_bit(todo)
                todo &= todo - 1
                dx = lane_x + (np.float32((block % BLOCKS_ACROSS) * BLOCK_WIDTH) - x)
                dy = lane_y + (np.float32((block // BLOCKS_ACROSS) * block_height) - y)
                u = fma(spread(ux, lanes), dx, dy * uy)
                power = exponent(u, dy * vy, spread(log_opacity, lanes))
                keep = power >= CUT
                raw = exp2_small(power)
                opaque = where(keep, minimum(raw, ALPHA_TOP), ZERO)
                inverse = ONE / (ONE - opaque)
                place = block * count
                g_opaque = _pull(state, place, record, records, opaque, inverse, grads, lanes, channels)
                if layers is not None:
                    g_opaque = g_opaque + _pull(
                        state, own + place, record, records, opaque, inverse, grads, lanes, channels
                    )
                h = where(raw < ALPHA_TOP, g_opaque * opaque, ZERO)
                put(grads, SUM_H, get(grads, SUM_H) + h)
                hu, hy = h * u, h * dy
                put(grads, SUM_HU, get(grads, SUM_HU) + hu)
                put(grads, SUM_HUX, fma(hu, dx, get(grads, SUM_HUX)))
                put(grads, SUM_HUY, fma(hu, dy, get(grads, SUM_HUY)))
                put(grads, SUM_HY, get(grads, SUM_HY) + hy)
                put(grads, SUM_HYY, fma(hy, dy, get(grads, SUM_HYY)))
            for k in range(0, length(slot), count):
                store(sums, entry * length(slot) + k, lane_sums(grads, k))

"""Backward blending: the same walk, front to back again.

With the final picture known, what lies behind a Gaussian is the total minus what came before it, so that no
list per pixel is kept and nothing is divided to recover a transmittance. Per pixel and picture,

    d(loss)/d(alpha_k) = T_k value_k - rest_k / (1 - alpha_k),   value_k = G . c_k + g_z z_k + g_alpha,
    rest_k = total - sum_{j<=k} w_j value_j,                     total = sum_j w_j value_j,

where g_alpha includes the background, which is visible through the remaining transmittance. Gradients of one
entry (tile, Gaussian) go to a separate slot: nothing is added concurrently, and the order of additions is
fixed.
"""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.blend import AHEAD, ONE, ZERO
from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.falloff import block_corner, falloff, numbers, pass_through, pixel_place
from stages.shared.splat.kernels.layout import (
    DEPTH,
    NUMBERS,
    SUM_DEPTH,
    SUM_H,
    SUM_HU,
    SUM_HUX,
    SUM_HUY,
    SUM_HV,
    SUM_HVY,
    TILE,
    TILE_PIXELS,
)
from stages.shared.splat.kernels.memory import (
    at,
    get,
    lane_sums,
    length,
    load,
    lowest_bit,
    next_item,
    prefetch,
    prefetch_to_write,
    put,
    register_tile,
    register_tile_at,
    set_at,
    store,
)
from stages.shared.splat.kernels.simd import fma, negative, where

# mypy: ignore-errors
# (compiled and type-checked by numba)

# Planes of a block: transmittance, rest, gradient of alpha, of depth, of colours.
_REST, _G_ALPHA, _G_DEPTH = 1, 2, 3
_PLANES = 4


@inlined
def _start_picture(
    state, base, picture, channels, count, top, left, width, height, background, features, first, alpha,
    depth, g_features, g_alpha, g_depth,
):  # fmt: skip
    """A tile's pixels of one picture; its colours and their gradients begin at `first`."""
    size = length(channels)
    planes = _PLANES + size
    if top + TILE > height or left + TILE > width:
        for place in range(base, base + planes * TILE_PIXELS):
            state[place] = ZERO
        for row in range(TILE):
            for column in range(TILE):
                state[base + pixel_place(row, column, count, planes)] = -ONE
    for row in range(top, min(top + TILE, height)):
        for column in range(left, min(left + TILE, width)):
            place = base + pixel_place(row - top, column - left, count, planes)
            pixel = (picture * height + row) * width + column
            colors = first + (row * width + column) * size
            behind, whole = ZERO, ZERO
            for c in range(size):
                g = at(g_features, colors + c)
                behind += g * at(background, c)
                whole += g * at(features, colors + c)
                set_at(state, place + (_PLANES + c) * count, g)
            of_alpha, of_depth = at(g_alpha, pixel), at(g_depth, pixel)
            # `features` contains the background, weighted by 1 - alpha: remove it.
            rest = whole - behind + at(alpha, pixel) * of_alpha + at(depth, pixel) * of_depth
            set_at(state, place, ONE)
            set_at(state, place + _REST * count, rest)
            set_at(state, place + _G_ALPHA * count, of_alpha - behind)
            set_at(state, place + _G_DEPTH * count, of_depth)


@inlined
def _pull(pixels, records, record, alpha, inverse, number, grads, channels):
    """One picture's part of d(loss)/d(alpha) of a block; adds depth and colour gradients to the tile."""
    before = get(pixels, 0)
    weight, after, still_open = pass_through(before, alpha, number)
    put(pixels, 0, after)
    value = get(pixels, _G_ALPHA)
    for channel in range(length(channels) + 1):
        incoming = get(pixels, _G_DEPTH + channel)
        value = fma(incoming, at(records, record + DEPTH + channel), value)
        put(grads, SUM_DEPTH + channel, fma(weight, incoming, get(grads, SUM_DEPTH + channel)))
    rest = fma(negative(weight), value, get(pixels, _REST))
    put(pixels, _REST, rest)
    return where(still_open, fma(before, value, negative(rest * inverse)), ZERO)


@inlined
def _visit(todo, state, base, planes, places, records, record, number, grads, channels, lanes):
    """Add to the tile the gradients of a Gaussian from the blocks `todo` of the picture at `base`."""
    count = len(lanes)
    while todo != 0:
        block = lowest_bit(todo)
        todo &= todo - 1
        pixel_x = load(places, 2 * block * count, lanes)
        pixel_y = load(places, (2 * block + 1) * count, lanes)
        x, y, u, v, power, alpha, _ = falloff(pixel_x, pixel_y, records, record, number, lanes)
        pixels = register_tile_at(state, base + block * planes * count, lanes)
        g_alpha = _pull(pixels, records, record, alpha, ONE / (ONE - alpha), number, grads, channels)
        h = where(power < number[8], g_alpha * alpha, ZERO)
        hu, hv = h * u, h * v
        put(grads, SUM_H, get(grads, SUM_H) + h)
        put(grads, SUM_HU, get(grads, SUM_HU) + hu)
        put(grads, SUM_HUX, fma(hu, x, get(grads, SUM_HUX)))
        put(grads, SUM_HUY, fma(hu, y, get(grads, SUM_HUY)))
        put(grads, SUM_HV, get(grads, SUM_HV) + hv)
        put(grads, SUM_HVY, fma(hv, y, get(grads, SUM_HVY)))


@kernel
def blend_backward(
    counter, starts, gaussians, slots, records, stride, background, features, alone_features, alpha, depth,
    blocks, layer_blocks, g_features, g_alone_features, g_alpha, g_depth, sums, width, height, layer_slots,
    alone, constants, lanes, channels, slot, alone_channels,
):  # fmt: skip
    """Gradients of the tiles this thread gets: sums (E * slot length,), in the slot of each entry.

    layer_slots, alone, alone_channels: as in `blend`.
    """
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    others = 0 if alone is None else alone
    planes, layer_planes = _PLANES + length(channels), _PLANES + length(alone_channels)
    first_other, other_size = planes * TILE_PIXELS, layer_planes * TILE_PIXELS
    kind = records.dtype
    state = np.empty(first_other + others * other_size, kind)
    places = np.empty(2 * TILE_PIXELS, kind)
    grads = register_tile(slot, np.empty(length(slot) * count, kind), lanes)
    number = numbers(constants, lanes)
    lane_x, lane_y = load(constants, NUMBERS * count, lanes), load(constants, (NUMBERS + 1) * count, lanes)
    zero = load(np.zeros(count, kind), 0, lanes)
    while True:
        tile = next_item(counter)
        if tile >= tiles:
            break
        first, last = starts[tile], starts[tile + 1]
        if first == last:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        _start_picture(
            state, 0, 0, channels, count, top, left, width, height, background, features, 0, alpha, depth,
            g_features, g_alpha, g_depth,
        )  # fmt: skip
        for other in range(others):
            _start_picture(
                state, first_other + other * other_size, 1 + other, alone_channels, count, top, left, width,
                height, background, alone_features, other * height * width * length(alone_channels), alpha,
                depth, g_alone_features, g_alpha, g_depth,
            )  # fmt: skip
        for block in range(TILE_PIXELS // count):
            corner_x, corner_y = block_corner(block, count, top, left)
            store(places, 2 * block * count, lane_x + np.float32(corner_x))
            store(places, (2 * block + 1) * count, lane_y + np.float32(corner_y))
        for entry in range(first, last):
            if entry + AHEAD < last:
                prefetch(records, at(gaussians, entry + AHEAD) * stride)
                prefetch_to_write(sums, np.int64(at(slots, entry + AHEAD)) * length(slot))
            todo, own_todo = np.int64(at(blocks, entry)), 0
            if alone is not None:
                own_todo = np.int64(at(layer_blocks, entry))
            if todo | own_todo == 0:
                for k in range(0, length(slot), count):
                    store(sums, np.int64(at(slots, entry)) * length(slot) + k, zero)
                continue
            record = at(gaussians, entry) * stride
            for k in range(length(slot)):
                put(grads, k, zero)
            _visit(todo, state, 0, planes, places, records, record, number, grads, channels, lanes)
            if alone is not None:
                base = first_other + (np.int64(at(layer_slots, at(gaussians, entry))) - 1) * other_size
                _visit(
                    own_todo, state, base, layer_planes, places, records, record, number, grads,
                    alone_channels, lanes,
                )  # fmt: skip
            for k in range(0, length(slot), count):
                store(sums, np.int64(at(slots, entry)) * length(slot) + k, lane_sums(grads, k))

"""Forward blending: every tile walks its list front to back, a block of pixels at a time.

State of a tile lies in L1: per picture ("set": the composite, then each layer alone) the planes transmittance,
depth, colours, each TILE_PIXELS floats in block order. A negative transmittance marks a pixel that stopped.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from stages.shared.splat.kernels.lanes import (
    at,
    bits,
    exp2_small,
    fma,
    length,
    load,
    lowest_bit,
    magnitude,
    minimum,
    prefetch,
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
    COLOR,
    DEPTH,
    LAYER,
    LOG_OPACITY,
    TILE,
    TILE_PIXELS,
    UX,
    UY,
    VY,
)
from stages.shared.splat.settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

# mypy: disable-error-code="no-untyped-def"

CUT = np.float32(math.log2(ALPHA_MIN))
ALPHA_TOP = np.float32(ALPHA_MAX)
STOP = np.float32(TRANSMITTANCE_MIN)
ZERO, ONE = np.float32(0.0), np.float32(1.0)
AHEAD = 8
"""List entries between asking for a record and using it: about the latency of the third-level cache."""


@njit(forceinline=True)
def exponent(u, v, log_opacity):
    """log2(alpha) = log_opacity - u^2 - v^2."""
    return fma(ZERO - u, u, fma(ZERO - v, v, log_opacity))


@njit(forceinline=True)
def pixel_place(row, column, block_height):
    """Where pixel (row, column) of a tile is in a plane."""
    block = (row // block_height) * BLOCKS_ACROSS + column // BLOCK_WIDTH
    return block * block_height * BLOCK_WIDTH + (row % block_height) * BLOCK_WIDTH + column % BLOCK_WIDTH


@njit(forceinline=True)
def _add(state, plane, record, records, alpha, lanes, channels):
    """Put a Gaussian behind what a block of one picture has so far; returns which lanes took it."""
    before = load(state, plane, lanes)
    after = fma(ZERO - alpha, before, before)
    open_lanes = after > STOP
    weight = where(open_lanes, before * alpha, ZERO)
    store(state, plane, where(open_lanes, after, ZERO - magnitude(before)))
    for channel in range(length(channels) + 1):
        plane += TILE_PIXELS
        store(state, plane, fma(weight, at(records, record + DEPTH + channel), load(state, plane, lanes)))
    return open_lanes


@njit(forceinline=True)
def _start_tile(state, live, sets, set_size, top, left, width, height, block_height):
    """Empty pixels; those outside the image are stopped. Returns the bits of blocks with a pixel inside."""
    state[:] = ZERO
    inside = 0
    for row in range(min(TILE, height - top)):
        for column in range(min(TILE, width - left)):
            place = pixel_place(row, column, block_height)
            inside |= 1 << (place // (block_height * BLOCK_WIDTH))
    for picture in range(sets):
        live[picture] = inside
        for place in range(TILE_PIXELS):
            state[picture * set_size + place] = -ONE
        for row in range(min(TILE, height - top)):
            for column in range(min(TILE, width - left)):
                state[picture * set_size + pixel_place(row, column, block_height)] = ONE


@njit(forceinline=True)
def _finish_tile(
    state, sets, set_size, top, left, width, height, block_height, background, features, alpha, depth
):
    """Write a tile's pixels, background behind them."""
    channels = len(background)
    for picture in range(sets):
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                place = picture * set_size + pixel_place(row - top, column - left, block_height)
                pixel = (picture * height + row) * width + column
                remaining = abs(state[place])
                alpha[pixel] = ONE - remaining
                depth[pixel] = state[place + TILE_PIXELS]
                for c in range(channels):
                    value = state[place + (2 + c) * TILE_PIXELS]
                    features[pixel * channels + c] = value + remaining * background[c]


@njit(forceinline=True)
def _empty_tile(sets, top, left, width, height, background, features, alpha, depth):
    channels = len(background)
    for picture in range(sets):
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                pixel = (picture * height + row) * width + column
                alpha[pixel] = ZERO
                depth[pixel] = ZERO
                for c in range(channels):
                    features[pixel * channels + c] = background[c]


@njit(nogil=True, cache=True, error_model="numpy")
def blend(
    turn, starts, gaussians, blocks, records, stride, background, features, alpha, depth,
    width, height, layers, ramps, lanes, channels,
):  # fmt: skip
    """Blend the tiles this thread gets.

    starts (tiles + 1,), gaussians (E,) rows of records, blocks (E,) bits: the tile lists, nearest first. `blocks`
    is narrowed to the blocks where an entry changed a pixel, which is all that the backward pass visits.
    layers: None, or how many are rendered alone beside the composite.
    """
    count = len(lanes)
    block_height = count // BLOCK_WIDTH
    columns = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    sets = 1 if layers is None else 1 + layers
    set_size = (2 + length(channels)) * TILE_PIXELS
    state = np.empty(sets * set_size, np.float32)
    live = np.empty(sets, np.int64)
    lane_x, lane_y = load(ramps, 0, lanes), load(ramps, count, lanes)
    while True:
        tile = take(turn)
        if tile >= tiles:
            break
        first, last = starts[tile], starts[tile + 1]
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        if first == last:
            _empty_tile(sets, top, left, width, height, background, features, alpha, depth)
            continue
        _start_tile(state, live, sets, set_size, top, left, width, height, block_height)
        stopped = False
        for entry in range(first, last):
            if entry + AHEAD < last:
                prefetch(records, at(gaussians, entry + AHEAD) * stride)
            todo = np.int64(at(blocks, entry))
            record = at(gaussians, entry) * stride
            own = 0
            if layers is None:
                todo &= live[0]
            else:
                own = 1 + np.int64(at(records, record + LAYER))
                todo &= live[0] | live[own]
            touched = 0
            if todo != 0:
                x, y = at(records, record + CENTER_X) - left, at(records, record + CENTER_Y) - top
                ux, uy = at(records, record + UX), at(records, record + UY)
                vy, log_opacity = at(records, record + VY), at(records, record + LOG_OPACITY)
                dead = False
                while todo != 0:
                    block = lowest_bit(todo)
                    todo &= todo - 1
                    dx = lane_x + (np.float32((block % BLOCKS_ACROSS) * BLOCK_WIDTH) - x)
                    dy = lane_y + (np.float32((block // BLOCKS_ACROSS) * block_height) - y)
                    power = exponent(fma(spread(ux, lanes), dx, dy * uy), dy * vy, spread(log_opacity, lanes))
                    keep = power >= CUT
                    opaque = where(keep, minimum(exp2_small(power), ALPHA_TOP), ZERO)
                    place = block * count
                    open_lanes = _add(state, place, record, records, opaque, lanes, channels)
                    taken = bits(open_lanes & keep)
                    if bits(open_lanes) == 0:
                        live[0] &= ~(1 << block)
                        dead = True
                    if layers is not None:
                        open_lanes = _add(
                            state, own * set_size + place, record, records, opaque, lanes, channels
                        )
                        taken |= bits(open_lanes & keep)
                        if bits(open_lanes) == 0:
                            live[own] &= ~(1 << block)
                            dead = True
                    if taken != 0:
                        touched |= 1 << block
                if dead:
                    stopped = True
                    for picture in range(sets):
                        if live[picture] != 0:
                            stopped = False
            blocks[entry] = touched
            if stopped:
                for rest in range(entry + 1, last):
                    blocks[rest] = 0
                break
        _finish_tile(
            state, sets, set_size, top, left, width, height, block_height, background, features, alpha, depth
        )


@njit(nogil=True, cache=True, error_model="numpy")
def median_depths(turn, starts, gaussians, blocks, records, stride, depth, width, height, layers):
    """Camera depth at which each pixel's transmittance first falls to one half; 0 where it never does.

    A plain loop over pixels: nobody differentiates it, and it is made only when asked for. Runs after `blend`.
    """
    columns = (width + TILE - 1) // TILE
    sets = 1 if layers is None else 1 + layers
    while True:
        tile = take(turn)
        if tile >= len(starts) - 1:
            break
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        for picture in range(sets):
            for row in range(top, min(top + TILE, height)):
                for column in range(left, min(left + TILE, width)):
                    before, found = ONE, ZERO
                    for entry in range(starts[tile], starts[tile + 1]):
                        r = gaussians[entry] * stride
                        if blocks[entry] == 0 or (picture > 0 and records[r + LAYER] != picture - 1):
                            continue
                        dx = np.float32(column + 0.5) - records[r + CENTER_X]
                        dy = np.float32(row + 0.5) - records[r + CENTER_Y]
                        u, v = records[r + UX] * dx + records[r + UY] * dy, records[r + VY] * dy
                        power = records[r + LOG_OPACITY] - u * u - v * v
                        if power < CUT:
                            continue
                        before *= ONE - min(np.float32(2.0**power), ALPHA_TOP)
                        if before <= np.float32(0.5):
                            found = records[r + DEPTH]
                            break
                    depth[(picture * height + row) * width + column] = found


__all__ = ["COLOR", "blend", "median_depths"]

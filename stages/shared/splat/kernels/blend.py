"""Forward blending: tile by tile, in two turns over a stretch of the tile's list.

First every Gaussian is tested against all blocks of the tile at once (a lane is a block). Then each block
walks the Gaussians that can reach it front to back, its pixels in registers, until all of them are opaque.
State between stretches lies in L1: for each picture (the composite, then each layer alone) and block the
planes transmittance, depth, colours.
"""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.falloff import block_corner, falloff, numbers, pass_through, pixel_place
from stages.shared.splat.kernels.lanes import bits, fma, magnitude, maximum
from stages.shared.splat.kernels.layout import (
    BLOCK_WIDTH,
    DEPTH,
    LOG_OPACITY,
    NUMBERS,
    TILE,
    TILE_PIXELS,
    U0,
    UX,
    UY,
    V0,
    VY,
    WHOLE_X,
    WHOLE_Y,
)
from stages.shared.splat.kernels.memory import (
    at,
    bank,
    bank_at,
    bit_column,
    get,
    length,
    load,
    lowest_bit,
    prefetch,
    put,
    set_at,
    spread,
    store,
    take,
)
from stages.shared.splat.settings import ALPHA_MAX

# mypy: ignore-errors
# (compiled and type-checked by numba)

ZERO, ONE = np.float32(0.0), np.float32(1.0)
AHEAD = 8
"""List entries between asking for a record and using it: about the latency of the third-level cache."""
_STRETCH = 256
"""List entries per turn: their records (64 bytes each) and the block lists stay in L1."""
_SLACK = np.float32(0.01)
"""Added to the reach of a Gaussian in the block test, in units of the exponent, against rounding."""


@inlined
def _start_tile(state, live, sets, planes, lanes, top, left, width, height):
    """Empty pixels; those outside the image are stopped from the beginning."""
    count = len(lanes)
    inside = 0
    for block in range(TILE_PIXELS // count):
        x, y = block_corner(block, count, top, left)
        if x < width and y < height:
            inside |= 1 << block
    for picture in range(sets):
        live[picture] = inside
    for place in range(0, sets * planes * TILE_PIXELS, count):
        store(state, place, spread(ZERO, lanes))
    for place in range(0, sets * planes * TILE_PIXELS, planes * count):
        store(state, place, spread(ONE, lanes))
    if top + TILE > height or left + TILE > width:
        for picture in range(sets):
            for row in range(TILE):
                for column in range(TILE):
                    if top + row >= height or left + column >= width:
                        place = pixel_place(row, column, count, planes)
                        state[picture * planes * TILE_PIXELS + place] = -ONE


@inlined
def _finish_tile(
    state, sets, planes, channels, count, top, left, width, height, background, features, alpha, depth
):  # fmt: skip
    """Write a tile's pixels, background behind them."""
    for picture in range(sets):
        base = picture * planes * TILE_PIXELS
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                place = base + pixel_place(row - top, column - left, count, planes)
                pixel = (picture * height + row) * width + column
                remaining = abs(at(state, place))
                set_at(alpha, pixel, ONE - remaining)
                set_at(depth, pixel, at(state, place + count))
                for c in range(length(channels)):
                    value = at(state, place + (2 + c) * count) + remaining * at(background, c)
                    set_at(features, pixel * length(channels) + c, value)


@inlined
def _empty_tile(sets, top, left, width, height, background_row, features, alpha, depth):
    """The background where nothing is; `background_row` is a row of a tile of it."""
    channels = len(background_row) // TILE
    across = min(TILE, width - left)
    for picture in range(sets):
        for row in range(top, min(top + TILE, height)):
            pixel = (picture * height + row) * width + left
            for i in range(across):
                set_at(alpha, pixel + i, ZERO)
                set_at(depth, pixel + i, ZERO)
            for i in range(across * channels):
                set_at(features, pixel * channels + i, at(background_row, i))


@inlined
def reached_blocks(records, record, constants, top, left, lanes):
    """Bits of the blocks that a Gaussian may reach: u and v are bounded over a block separately.

    u = UX X + UY Y + U0 is its value in the block's middle +- (UX half width + |UY| half height); v likewise.
    The Gaussian stays under the cut where the least |u| and the least |v| already give u^2 + v^2 > reach.
    """
    count = len(lanes)
    ux, u_y, u0 = at(records, record + UX), at(records, record + UY), at(records, record + U0)
    vy, v0 = at(records, record + VY), at(records, record + V0)
    x = np.float32(left) - at(records, record + WHOLE_X)
    y = np.float32(top) - at(records, record + WHOLE_Y)
    half_width = np.float32(0.5 * (BLOCK_WIDTH - 1))
    half_height = np.float32(0.5) * np.float32(count // BLOCK_WIDTH - 1)
    span_u, span_v = ux * half_width + abs(u_y) * half_height, vy * half_height
    reach = at(records, record + LOG_OPACITY) - at(constants, 7 * count) + _SLACK
    middles = (NUMBERS + 2) * count
    found = 0
    for block in range(0, TILE_PIXELS // count, count):
        middle_x = load(constants, middles + block, lanes) + x
        middle_y = load(constants, middles + TILE_PIXELS // count + block, lanes) + y
        u = maximum(magnitude(middle_x * ux + (middle_y * u_y + u0)) - span_u, ZERO)
        v = maximum(magnitude(middle_y * vy + v0) - span_v, ZERO)
        found |= bits(fma(u, u, v * v) <= reach) << block
    return found


@inlined
def _add(pixels, records, record, alpha, number, channels):
    """Put a Gaussian behind what a block of one picture has so far; returns which lanes are still open."""
    weight, after, still_open = pass_through(get(pixels, 0), alpha, number)
    put(pixels, 0, after)
    for channel in range(length(channels) + 1):
        put(pixels, 1 + channel, fma(weight, at(records, record + DEPTH + channel), get(pixels, 1 + channel)))
    return still_open


@inlined
def _add_layered(
    pixels, state, live, bit, own, set_size, block_place, records, record, alpha, keep, number, lanes,
    channels,
):  # fmt: skip
    """The same for the composite and the Gaussian's own layer: (changed a pixel, a picture is open here)."""
    touched = 0
    if live[0] & bit != 0:
        still_open = _add(pixels, records, record, alpha, number, channels)
        touched |= bits(still_open & keep)
        if bits(still_open) == 0:
            live[0] &= ~bit
    if live[own] & bit != 0:
        alone = bank_at(state, own * set_size + block_place, lanes)
        still_open = _add(alone, records, record, alpha, number, channels)
        touched |= bits(still_open & keep)
        if bits(still_open) == 0:
            live[own] &= ~bit
    anything = np.int64(0)
    for picture in range(len(live)):
        anything |= live[picture] & bit
    return touched != 0, anything != 0


@kernel
def blend(
    turn, starts, gaussians, records, stride, background, features, alpha, depth, blocks, width, height,
    layer_ids, layers, constants, lanes, channels, planes,
):  # fmt: skip
    """Blend the tiles this thread gets.

    starts (tiles + 1,), gaussians (E,) rows of records: the tile lists, nearest first. blocks (E,) uint32:
    gets the blocks in which an entry changed a pixel, one bit each, all that the backward pass visits.
    layer_ids, layers: None, or the layer of
    each row and how many there are, rendered alone beside the composite. planes: 2 + channels, as a size.
    """
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    sets = 1 if layers is None else 1 + layers
    depth_and_colors = length(planes)
    set_size = depth_and_colors * TILE_PIXELS
    state = np.empty(sets * set_size, np.float32)
    live = np.empty(sets, np.int64)
    reached = np.empty(_STRETCH, np.int32)
    pixels = bank(planes, np.empty(depth_and_colors * count, np.float32), lanes)
    background_row = np.empty(TILE * len(background), np.float32)
    for i in range(len(background_row)):
        background_row[i] = background[i % len(background)]
    number = numbers(constants, lanes)
    lane_x, lane_y = load(constants, NUMBERS * count, lanes), load(constants, (NUMBERS + 1) * count, lanes)
    while True:
        tile = take(turn)
        if tile >= tiles:
            break
        first, last = starts[tile], starts[tile + 1]
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        if first == last:
            _empty_tile(sets, top, left, width, height, background_row, features, alpha, depth)
            continue
        _start_tile(state, live, sets, depth_and_colors, lanes, top, left, width, height)
        for begin in range(first, last, _STRETCH):
            end = min(begin + _STRETCH, last)
            anything = live[0]
            if layers is not None:
                for picture in range(1, sets):
                    anything |= live[picture]
            if anything == 0:
                for entry in range(begin, last):
                    blocks[entry] = 0
                break
            union = 0
            for entry in range(begin, end):
                if entry + AHEAD < last:
                    prefetch(records, at(gaussians, entry + AHEAD) * stride)
                set_at(blocks, entry, np.uint32(0))
                record = at(gaussians, entry) * stride
                todo = live[0]
                if layers is not None:
                    todo |= live[1 + np.int64(at(layer_ids, at(gaussians, entry)))]
                todo &= reached_blocks(records, record, constants, top, left, lanes)
                union |= todo
                set_at(reached, entry - begin, np.int32(todo))
            for rest in range(end - begin, (end - begin + 63) & ~63):
                reached[rest] = 0
            while union != 0:
                block = lowest_bit(union)
                union &= union - 1
                bit = 1 << block
                corner_x, corner_y = block_corner(block, count, top, left)
                pixel_x, pixel_y = lane_x + np.float32(corner_x), lane_y + np.float32(corner_y)
                kept = bank_at(state, block * depth_and_colors * count, lanes)
                for plane in range(length(planes)):
                    put(pixels, plane, get(kept, plane))
                any_open = True
                for word in range(begin, end, 64):
                    todo = 0
                    for part in range(0, 64, count):
                        todo |= bit_column(reached, word - begin + part, bit, lanes) << part
                    while todo != 0 and any_open:
                        entry = word + lowest_bit(todo)
                        todo &= todo - 1
                        record = at(gaussians, entry) * stride
                        _, _, _, _, _, opaque, keep = falloff(
                            pixel_x, pixel_y, records, record, number, lanes
                        )
                        if layers is None:
                            still_open = _add(pixels, records, record, opaque, number, channels)
                            touched = bits(still_open & keep) != 0
                            any_open = bits(still_open) != 0
                        else:
                            own = 1 + np.int64(at(layer_ids, at(gaussians, entry)))
                            touched, any_open = _add_layered(
                                pixels, state, live, bit, own, set_size, block * depth_and_colors * count,
                                records, record, opaque, keep, number, lanes, channels,
                            )  # fmt: skip
                        # Without a branch: it would be mispredicted every fourth time.
                        set_at(blocks, entry, at(blocks, entry) | (np.uint32(touched) << np.uint32(block)))
                if layers is None and not any_open:
                    live[0] &= ~bit
                for plane in range(length(planes)):
                    put(kept, plane, get(pixels, plane))
        _finish_tile(
            state, sets, depth_and_colors, channels, count, top, left, width, height, background, features,
            alpha, depth,
        )  # fmt: skip


@kernel
def median_depths(
    turn,
    starts,
    gaussians,
    blocks,
    records,
    stride,
    depth,
    width,
    height,
    layer_ids,
    layers,
    constants,
    count,
):
    """Camera depth at which each pixel's transmittance first falls to one half; 0 where it never does.

    A plain loop over pixels: nobody differentiates it, and it is made only when asked for. Runs after blend.
    """
    columns = (width + TILE - 1) // TILE
    sets = 1 if layers is None else 1 + layers
    cut = constants[7 * count]
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
                        if blocks[entry] == 0:
                            continue
                        if (
                            layer_ids is not None
                            and picture > 0
                            and layer_ids[gaussians[entry]] != picture - 1
                        ):
                            continue
                        x = np.float32(column + 0.5) - records[r + WHOLE_X]
                        y = np.float32(row + 0.5) - records[r + WHOLE_Y]
                        u = records[r + UX] * x + (records[r + UY] * y + records[r + U0])
                        v = records[r + VY] * y + records[r + V0]
                        exponent = records[r + LOG_OPACITY] - u * u - v * v
                        if exponent < cut:
                            continue
                        before *= ONE - min(np.float32(2.0**exponent), np.float32(ALPHA_MAX))
                        if before <= np.float32(0.5):
                            found = records[r + DEPTH]
                            break
                    depth[(picture * height + row) * width + column] = found

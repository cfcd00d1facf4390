"""Forward blending: tile by tile, in two passes over a stretch of the tile's list.

First every Gaussian is tested against all blocks of the tile at once (a lane is a block). Then each block
walks the Gaussians that can reach it front to back, its pixels in registers, until all of them are opaque.
State between stretches lies in L1: for each picture (the composite, then the layers alone) and block the
planes transmittance, depth, colours. Layers alone may have fewer colours than the composite.
"""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.falloff import block_corner, falloff, numbers, pass_through, pixel_place
from stages.shared.splat.kernels.layout import (
    BLOCK_WIDTH,
    CUT,
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
    bit_column,
    get,
    length,
    load,
    lowest_bit,
    next_item,
    prefetch,
    put,
    register_tile,
    register_tile_at,
    set_at,
)
from stages.shared.splat.kernels.simd import bits, fma, magnitude, maximum
from stages.shared.splat.settings import ALPHA_MAX

# mypy: ignore-errors
# (compiled and type-checked by numba)

ZERO, ONE = np.float32(0.0), np.float32(1.0)
AHEAD = 8
"""List entries between prefetch and use of a record: about the latency of the third-level cache."""
STRETCH = 256
"""List entries per stretch: their records (64 bytes each) and the block lists stay in L1."""
_SLACK = np.float32(0.01)
"""Added to the reach of a Gaussian in the block test, in units of the exponent, against rounding."""


@inlined
def _blocks_inside(lanes, top, left, width, height):
    """Bits of a tile's blocks that reach into the image."""
    count = len(lanes)
    inside = 0
    for block in range(TILE_PIXELS // count):
        x, y = block_corner(block, count, top, left)
        if x < width and y < height:
            inside |= 1 << block
    return inside


@inlined
def start_pictures(state, base, sets, planes, lanes, top, left, width, height):
    """Empty pixels of `sets` pictures; those outside the image are stopped from the beginning."""
    count = len(lanes)
    state[base : base + sets * planes * TILE_PIXELS] = 0.0
    for place in range(base, base + sets * planes * TILE_PIXELS, planes * count):
        state[place : place + count] = 1.0
    if top + TILE > height or left + TILE > width:
        for picture in range(sets):
            for row in range(TILE):
                for column in range(TILE):
                    if top + row >= height or left + column >= width:
                        place = pixel_place(row, column, count, planes)
                        state[base + picture * planes * TILE_PIXELS + place] = -ONE


@inlined
def _finish_picture(
    state, base, picture, planes, count, top, left, width, height, background, features, first, alpha, depth
):  # fmt: skip
    """Write a tile's pixels of one picture, background behind them; its colours begin at features[first]."""
    channels = length(planes) - 2
    for row in range(top, min(top + TILE, height)):
        for column in range(left, min(left + TILE, width)):
            place = base + pixel_place(row - top, column - left, count, length(planes))
            pixel = row * width + column
            remaining = abs(at(state, place))
            set_at(alpha, picture * height * width + pixel, ONE - remaining)
            set_at(depth, picture * height * width + pixel, at(state, place + count))
            for c in range(channels):
                value = at(state, place + (2 + c) * count) + remaining * at(background, c)
                set_at(features, first + pixel * channels + c, value)


@inlined
def _empty_picture(picture, planes, top, left, width, height, background, features, first, alpha, depth):
    """The background where nothing is."""
    across, channels = min(TILE, width - left), length(planes) - 2
    for row in range(top, min(top + TILE, height)):
        pixel = row * width + left
        for i in range(across):
            set_at(alpha, picture * height * width + pixel + i, ZERO)
            set_at(depth, picture * height * width + pixel + i, ZERO)
            for c in range(channels):
                set_at(features, first + (pixel + i) * channels + c, at(background, c))


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
    reach = at(records, record + LOG_OPACITY) - at(constants, CUT * count) + _SLACK
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
def walk(
    state, base, planes, pixels, members, reached, block, gaussians, begin, end, records, stride, blocks,
    constants, number, top, left, lanes,
):  # fmt: skip
    """Blend a stretch's Gaussians into one block of one picture; whether the block is still open.

    base: where the block begins in `state`. members: None, or which entries the picture shows, a bit each.
    """
    count = len(lanes)
    bit = 1 << block
    corner_x, corner_y = block_corner(block, count, top, left)
    pixel_x = load(constants, NUMBERS * count, lanes) + np.float32(corner_x)
    pixel_y = load(constants, (NUMBERS + 1) * count, lanes) + np.float32(corner_y)
    kept = register_tile_at(state, base, lanes)
    for plane in range(length(planes)):
        put(pixels, plane, get(kept, plane))
    any_open = True
    for word in range(begin, end, 64):
        todo = 0
        for part in range(0, 64, count):
            todo |= bit_column(reached, word - begin + part, bit, lanes) << part
        if members is not None:
            todo &= at(members, (word - begin) >> 6)
        while todo != 0 and any_open:
            entry = word + lowest_bit(todo)
            todo &= todo - 1
            record = at(gaussians, entry) * stride
            _, _, _, _, _, alpha, keep = falloff(pixel_x, pixel_y, records, record, number, lanes)
            weight, after, still_open = pass_through(get(pixels, 0), alpha, number)
            put(pixels, 0, after)
            for plane in range(1, length(planes)):
                value = at(records, record + DEPTH - 1 + plane)
                put(pixels, plane, fma(weight, value, get(pixels, plane)))
            any_open = bits(still_open) != 0
            touched = np.uint32(bits(still_open & keep) != 0)
            # Without a branch: it would be mispredicted every fourth time.
            set_at(blocks, entry, at(blocks, entry) | (touched << np.uint32(block)))
    for plane in range(length(planes)):
        put(kept, plane, get(pixels, plane))
    return any_open


@kernel
def blend(
    counter, starts, gaussians, records, stride, background, features, alone_features, alpha, depth, blocks,
    layer_blocks, width, height, layer_slots, alone, constants, lanes, planes, layer_planes,
):  # fmt: skip
    """Blend the tiles this thread gets.

    starts (tiles + 1,), gaussians (E,) rows of records: the tile lists, nearest first. blocks, layer_blocks
    (E,) uint32: set to the blocks in which an entry changed a pixel of the composite, and of its layer's
    picture, one bit each: the backward pass visits only these. layer_slots, alone: None, or for each row the
    number of its layer's picture, from 1 on (0: only the composite shows it), and the number of layers that
    are rendered alone. planes, layer_planes: 2 + channels of either, as sizes.
    """
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    others = 0 if alone is None else alone
    size, layer_size = length(planes) * count, length(layer_planes) * count
    # In `state` the composite comes first, then the others, which may have fewer planes.
    first_other, other_size = length(planes) * TILE_PIXELS, length(layer_planes) * TILE_PIXELS
    kind = records.dtype
    state = np.empty(first_other + others * other_size, kind)
    live = np.empty(1 + others, np.int64)
    reached = np.empty(STRETCH, np.int32)
    members = np.empty((1 + others, STRETCH // 64), np.int64)
    pixels = register_tile(planes, np.empty(size, kind), lanes)
    layer_pixels = register_tile(layer_planes, np.empty(layer_size, kind), lanes)
    number = numbers(constants, lanes)
    while True:
        tile = next_item(counter)
        if tile >= tiles:
            break
        first, last = starts[tile], starts[tile + 1]
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        if first == last:
            _empty_picture(0, planes, top, left, width, height, background, features, 0, alpha, depth)
            for other in range(others):
                _empty_picture(
                    1 + other, layer_planes, top, left, width, height, background, alone_features,
                    other * height * width * (length(layer_planes) - 2), alpha, depth,
                )  # fmt: skip
            continue
        live[:] = _blocks_inside(lanes, top, left, width, height)
        start_pictures(state, 0, 1, length(planes), lanes, top, left, width, height)
        if alone is not None:
            start_pictures(state, first_other, others, length(layer_planes), lanes, top, left, width, height)
        for begin in range(first, last, STRETCH):
            end = min(begin + STRETCH, last)
            anything = at(live, 0)
            if alone is not None:
                members[:] = 0
                for picture in range(1, 1 + others):
                    anything |= at(live, picture)
            if anything == 0:
                for entry in range(begin, last):
                    blocks[entry] = 0
                    if alone is not None:
                        layer_blocks[entry] = 0
                break
            union = 0
            for entry in range(begin, end):
                if entry + AHEAD < last:
                    prefetch(records, at(gaussians, entry + AHEAD) * stride)
                set_at(blocks, entry, np.uint32(0))
                record = at(gaussians, entry) * stride
                if alone is not None:
                    set_at(layer_blocks, entry, np.uint32(0))
                    own = np.int64(at(layer_slots, at(gaussians, entry)))
                    members[own, (entry - begin) >> 6] |= 1 << ((entry - begin) & 63)
                todo = anything & reached_blocks(records, record, constants, top, left, lanes)
                union |= todo
                set_at(reached, entry - begin, np.int32(todo))
            for rest in range(end - begin, (end - begin + 63) & ~63):
                reached[rest] = 0
            while union != 0:
                block = lowest_bit(union)
                union &= union - 1
                bit = 1 << block
                if at(live, 0) & bit != 0 and not walk(
                    state, block * size, planes, pixels, None, reached, block, gaussians, begin, end, records,
                    stride, blocks, constants, number, top, left, lanes,
                ):  # fmt: skip
                    live[0] &= ~bit
                if alone is not None:
                    for picture in range(1, 1 + others):
                        place = first_other + (picture - 1) * other_size + block * layer_size
                        if at(live, picture) & bit != 0 and not walk(
                            state, place, layer_planes, layer_pixels, members[picture], reached, block,
                            gaussians, begin, end, records, stride, layer_blocks, constants, number, top,
                            left, lanes,
                        ):  # fmt: skip
                            live[picture] &= ~bit
        _finish_picture(
            state, 0, 0, planes, count, top, left, width, height, background, features, 0, alpha, depth
        )
        for other in range(others):
            _finish_picture(
                state, first_other + other * other_size, 1 + other, layer_planes, count, top, left, width,
                height, background, alone_features, other * height * width * (length(layer_planes) - 2),
                alpha, depth,
            )  # fmt: skip


@kernel
def median_depths(
    counter, starts, gaussians, blocks, layer_blocks, records, stride, depth, width, height, layer_slots,
    alone, constants, lanes,
):  # fmt: skip
    """Camera depth at which each pixel's transmittance first falls to one half; 0 where it never does.

    A plain loop over pixels: it has no gradient and is computed only on request. Runs after `blend`.
    """
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    sets = 1 if alone is None else 1 + alone
    cut = constants[CUT * count]
    while True:
        tile = next_item(counter)
        if tile >= len(starts) - 1:
            break
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        for picture in range(sets):
            for row in range(top, min(top + TILE, height)):
                for column in range(left, min(left + TILE, width)):
                    before, found = 1.0, ZERO
                    for entry in range(starts[tile], starts[tile + 1]):
                        r = gaussians[entry] * stride
                        shown = blocks[entry] != 0
                        if alone is not None and picture > 0:
                            shown = layer_blocks[entry] != 0 and layer_slots[gaussians[entry]] == picture
                        if not shown:
                            continue
                        x = np.float32(column + 0.5) - records[r + WHOLE_X]
                        y = np.float32(row + 0.5) - records[r + WHOLE_Y]
                        u = records[r + UX] * x + (records[r + UY] * y + records[r + U0])
                        v = records[r + VY] * y + records[r + V0]
                        exponent = records[r + LOG_OPACITY] - u * u - v * v
                        if exponent < cut:
                            continue
                        before *= 1.0 - min(2.0**exponent, ALPHA_MAX)
                        if before <= 0.5:
                            found = records[r + DEPTH]
                            break
                    depth[(picture * height + row) * width + column] = found

"""The penetration pass on the tiles of a picture: a layer is rendered alone only where a pixel needs it.

`stages/shared/outfit/penetration.py` states the rule on whole pictures; this is the same rule tile by tile,
on the lists that the composite was blended from. Blocks without a pixel that may change are skipped. The
inner layer is rendered only where its nearest Gaussian of the tile does not already show that it is behind.
"""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.blend import AHEAD, STRETCH, reached_blocks, start_pictures, walk
from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.falloff import numbers, pixel_place
from stages.shared.splat.kernels.layout import BLOCK_WIDTH, BLOCKS_ACROSS, DEPTH, TILE, TILE_PIXELS
from stages.shared.splat.kernels.memory import (
    at,
    length,
    lowest_bit,
    next_item,
    prefetch,
    register_tile,
    set_at,
)

# mypy: ignore-errors
# (compiled and type-checked by numba)

ALONE_CHANNELS = 3
"""Colours, which a replaced pixel takes from the layer alone, together with alpha and depth."""
_SLACK = np.float32(1e-3)
"""Metres by which the nearest Gaussian must be behind to decide: far above what rounding does to a mean."""
_WINNER_SHIFT = 24
"""A decided pixel has a bit for every layer that is too thin there and, from this bit on, the layer that won
it (plus one): another pair with the same outer layer would change nothing."""
_LEAST_ALPHA = np.float32(1e-4)
"""Thinner than this a layer has no depth, and counts as infinitely far."""


@kernel
def mark_shown(features, alpha, layer, channels, width, top, left, shown):
    """shown (h, w) uint8: pixels of the box at (top, left) in which a layer has more than half.

    features (H * W * channels,), alpha (H * W,) of the composite.
    """
    half = np.float32(0.5)
    for row in range(shown.shape[0]):
        for column in range(shown.shape[1]):
            pixel = (top + row) * width + left + column
            most = at(features, pixel * channels + 3 + layer) > half and at(alpha, pixel) >= half
            shown[row, column] = np.uint8(most)


@kernel
def blend_layer(
    blocks, layer, begin, end, gaussians, layer_ids, records, stride, state, rows, reached, touched,
    width, height, top, left, constants, lanes, planes,
):  # fmt: skip
    """Blend one layer's Gaussians of a tile's list [begin, end) into the blocks `blocks` of `state`.

    rows, reached, touched: scratch of `STRETCH` entries.
    """
    count = len(lanes)
    size = length(planes) * count
    number = numbers(constants, lanes)
    pixels = register_tile(planes, np.empty(size, records.dtype), lanes)
    start_pictures(state, 0, 1, length(planes), lanes, top, left, width, height)
    live, entry = blocks, begin
    while entry < end and live != 0:
        members, union = 0, 0
        while entry < end and members < STRETCH:
            if entry + AHEAD < end:
                prefetch(layer_ids, np.int64(at(gaussians, entry + AHEAD)))
            row = np.int64(at(gaussians, entry))
            if at(layer_ids, row) == layer:
                set_at(rows, members, np.int32(row))
                members += 1
            entry += 1
        for place in range(members):
            if place + AHEAD < members:
                prefetch(records, np.int64(at(rows, place + AHEAD)) * stride)
            record = np.int64(at(rows, place)) * stride
            todo = live & reached_blocks(records, record, constants, top, left, lanes)
            union |= todo
            set_at(reached, place, np.int32(todo))
        for rest in range(members, (members + 63) & ~63):
            set_at(reached, rest, np.int32(0))
        while union != 0:
            block = lowest_bit(union)
            union &= union - 1
            if not walk(
                state, block * size, planes, pixels, None, reached, block, rows, 0, members, records, stride,
                touched, constants, number, top, left, lanes,
            ):  # fmt: skip
                live &= ~(1 << block)


@inlined
def _winner(features, place, layers):
    """The layer that shows most of itself in a pixel, the first of equals."""
    best, most = 0, at(features, place + 3)
    for layer in range(1, layers):
        value = at(features, place + 3 + layer)
        if value > most:
            best, most = layer, value
    return best


@inlined
def _nearest(layer, begin, end, gaussians, layer_ids, records, stride):
    """Camera depth of the first Gaussian of a layer in a tile's list, infinity without one."""
    for entry in range(begin, end):
        row = np.int64(at(gaussians, entry))
        if at(layer_ids, row) == layer:
            return at(records, row * stride + DEPTH)
    return np.float32(np.inf)


@inlined
def _mean_depth(state, place, count):
    """(alpha, mean depth) of a pixel of a layer alone."""
    alpha = np.float32(1.0) - abs(at(state, place))
    return alpha, at(state, place + count) / alpha if alpha > _LEAST_ALPHA else np.float32(np.inf)


@kernel
def resolve_tiles(
    counter, inside, starts, gaussians, layer_ids, records, stride, inner, outer, layers, margin, opaque,
    features, alpha, depth, repaired, decided, counts, width, height, constants, lanes, planes,
):  # fmt: skip
    """Replace what an inner layer shows through an outer one, in the tiles this thread gets.

    inside (H * W,) uint8: pixels within the outer's outlines. layer_ids (N,) int32. features (H * W * (3 +
    layers),), alpha, depth (H * W,): of the composite, changed in place. repaired (H * W,) uint8: set where
    the inner layer had won. decided (H * W,) int32: results of earlier pairs, zero at first. counts (tiles,)
    int64: pixels that the inner layer had won. planes: 2 + 3, as a size.
    """
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    channels = 3 + layers
    rows, reached = np.empty(STRETCH, np.int32), np.empty(STRETCH, np.int32)
    touched = np.zeros(STRETCH, np.uint32)
    outer_state = np.empty(length(planes) * TILE_PIXELS, records.dtype)
    inner_state = np.empty(length(planes) * TILE_PIXELS, records.dtype)
    candidates = np.empty(TILE_PIXELS, np.int32)
    block_height = count // BLOCK_WIDTH
    while True:
        tile = next_item(counter)
        if tile >= len(starts) - 1:
            break
        begin, end = starts[tile], starts[tile + 1]
        if begin == end:
            continue
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        candidate_count, blocks = 0, 0
        for row in range(top, min(top + TILE, height)):
            for column in range(left, min(left + TILE, width)):
                pixel = row * width + column
                decision = at(decided, pixel)
                if (
                    at(inside, pixel) == 0
                    or (decision >> outer) & 1
                    or decision >> _WINNER_SHIFT == outer + 1
                ):
                    continue
                winner = _winner(features, pixel * channels, layers)
                if winner in (inner, outer):
                    set_at(candidates, candidate_count, np.int32((row - top) * TILE + column - left))
                    candidate_count += 1
                    block = ((row - top) // block_height) * BLOCKS_ACROSS + (column - left) // BLOCK_WIDTH
                    blocks |= 1 << block
        if candidate_count == 0:
            continue
        blend_layer(
            blocks, outer, begin, end, gaussians, layer_ids, records, stride, outer_state, rows, reached,
            touched, width, height, top, left, constants, lanes, planes,
        )  # fmt: skip
        nearest = _nearest(inner, begin, end, gaussians, layer_ids, records, stride)
        opaque_count, blocks = 0, 0
        for k in range(candidate_count):
            row, column = at(candidates, k) // TILE, at(candidates, k) % TILE
            outer_alpha, outer_depth = _mean_depth(
                outer_state, pixel_place(row, column, count, length(planes)), count
            )
            if outer_alpha > opaque:
                set_at(candidates, opaque_count, at(candidates, k))
                opaque_count += 1
                if nearest < outer_depth - margin + _SLACK:
                    blocks |= 1 << ((row // block_height) * BLOCKS_ACROSS + column // BLOCK_WIDTH)
            else:
                pixel = (top + row) * width + left + column
                set_at(decided, pixel, np.int32(at(decided, pixel) | 1 << outer))
        if blocks != 0:
            blend_layer(
                blocks, inner, begin, end, gaussians, layer_ids, records, stride, inner_state, rows, reached,
                touched, width, height, top, left, constants, lanes, planes,
            )  # fmt: skip
        wrong = 0
        for k in range(opaque_count):
            row, column = at(candidates, k) // TILE, at(candidates, k) % TILE
            place = pixel_place(row, column, count, length(planes))
            outer_alpha, outer_depth = _mean_depth(outer_state, place, count)
            if blocks >> ((row // block_height) * BLOCKS_ACROSS + column // BLOCK_WIDTH) & 1:
                _, inner_depth = _mean_depth(inner_state, place, count)
                if not inner_depth >= outer_depth - margin:
                    continue
            pixel = (top + row) * width + left + column
            if _winner(features, pixel * channels, layers) == inner:
                set_at(repaired, pixel, np.uint8(1))
                wrong += 1
            for c in range(3):
                set_at(features, pixel * channels + c, at(outer_state, place + (2 + c) * count))
            for layer in range(layers):
                set_at(
                    features, pixel * channels + 3 + layer, outer_alpha if layer == outer else np.float32(0)
                )
            thin = at(decided, pixel) & ((1 << _WINNER_SHIFT) - 1)
            set_at(decided, pixel, np.int32(thin | (outer + 1) << _WINNER_SHIFT))
            set_at(alpha, pixel, outer_alpha)
            set_at(depth, pixel, at(outer_state, place + count))
        counts[tile] = wrong

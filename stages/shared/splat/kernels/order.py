"""Depth order and tile lists: a radix sort of float32 depths, then a counting sort into tiles.

Gaussians enter the tiles nearest first, so that no tile has to sort. Both sorts are stable: the lists depend on
the scene only, not on how the work was shared.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.shared.splat.kernels.lanes import at, prefetch, take
from stages.shared.splat.kernels.layout import BLOCK_WIDTH_SHIFT, BLOCKS_ACROSS, TILE_SHIFT

# mypy: disable-error-code="no-untyped-def"

_DIGIT = 11
_BUCKETS = 1 << _DIGIT
_AHEAD = 16


@njit(nogil=True, cache=True, error_model="numpy")
def depth_order(keys, counts, first_slots):
    """Rows with counts > 0 in order of `keys` (float32 depths > 0 read as uint32), ties by row.

    Also fills first_slots (N + 1,) with the running total of counts: where each row's slots begin.
    """
    n = len(keys)
    histogram = np.zeros((3, _BUCKETS), np.int64)
    keys_a, rows_a = np.empty(n, np.uint32), np.empty(n, np.int32)
    visible, total = 0, 0
    for i in range(n):
        first_slots[i] = total
        if counts[i] > 0:
            total += counts[i]
            key = keys[i]
            keys_a[visible], rows_a[visible] = key, i
            histogram[0, key & (_BUCKETS - 1)] += 1
            histogram[1, (key >> _DIGIT) & (_BUCKETS - 1)] += 1
            histogram[2, key >> (2 * _DIGIT)] += 1
            visible += 1
    first_slots[n] = total
    keys_b, rows_b = np.empty(visible, np.uint32), np.empty(visible, np.int32)
    for digit in range(3):
        shift = digit * _DIGIT
        if visible == 0 or histogram[digit, (keys_a[0] >> shift) & (_BUCKETS - 1)] == visible:
            continue  # all share this digit, as the high bits of depths mostly do
        place = 0
        for bucket in range(_BUCKETS):
            size = histogram[digit, bucket]
            histogram[digit, bucket] = place
            place += size
        for i in range(visible):
            bucket = (keys_a[i] >> shift) & (_BUCKETS - 1)
            place = histogram[digit, bucket]
            histogram[digit, bucket] = place + 1
            keys_b[place], rows_b[place] = keys_a[i], rows_a[i]
        keys_a, keys_b, rows_a, rows_b = keys_b, keys_a, rows_b, rows_a
    return rows_a[:visible]


@njit(nogil=True, cache=True, error_model="numpy")
def count_tiles(turn, order, boxes, columns, tallies):
    """Entries per tile, chunk of the order by chunk: tallies (chunks, tiles), zeroed before."""
    chunks = len(tallies)
    while True:
        chunk = take(turn)
        if chunk >= chunks:
            break
        for rank in range(chunk * len(order) // chunks, (chunk + 1) * len(order) // chunks):
            box = 4 * np.int64(at(order, rank))
            left, top = at(boxes, box) >> TILE_SHIFT, at(boxes, box + 1) >> TILE_SHIFT
            right, bottom = at(boxes, box + 2) >> TILE_SHIFT, at(boxes, box + 3) >> TILE_SHIFT
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    tallies[chunk, row * columns + column] += 1


@njit(nogil=True, cache=True, error_model="numpy")
def place_tiles(tallies, starts):
    """Counts per (chunk, tile) -> first place of each, in tile order and chunk order within; starts of tiles."""
    place = 0
    for tile in range(tallies.shape[1]):
        starts[tile] = place
        for chunk in range(tallies.shape[0]):
            size = tallies[chunk, tile]
            tallies[chunk, tile] = place
            place += size
    starts[tallies.shape[1]] = place


@njit(nogil=True, cache=True, error_model="numpy")
def fill_tiles(
    turn, order, boxes, first_slots, columns, block_height_shift, tallies, gaussians, blocks, slots
):
    """Write the tile lists: row and block bits of every entry; and for every row where its entries went."""
    chunks = len(tallies)
    blocks_down_shift = TILE_SHIFT - block_height_shift
    column_mask, row_mask = BLOCKS_ACROSS - 1, (1 << blocks_down_shift) - 1
    while True:
        chunk = take(turn)
        if chunk >= chunks:
            break
        stop = (chunk + 1) * len(order) // chunks
        for rank in range(chunk * len(order) // chunks, stop):
            if rank + _AHEAD < stop:
                prefetch(boxes, 4 * np.int64(at(order, rank + _AHEAD)))
                prefetch(first_slots, np.int64(at(order, rank + _AHEAD)))
            row_index = np.int64(at(order, rank))
            box, slot = 4 * row_index, np.int64(at(first_slots, row_index))
            left = np.int64(at(boxes, box)) >> BLOCK_WIDTH_SHIFT
            top = np.int64(at(boxes, box + 1)) >> block_height_shift
            right = np.int64(at(boxes, box + 2)) >> BLOCK_WIDTH_SHIFT
            bottom = np.int64(at(boxes, box + 3)) >> block_height_shift
            for row in range(top >> blocks_down_shift, (bottom >> blocks_down_shift) + 1):
                first = max(top - (row << blocks_down_shift), 0)
                last = min(bottom - (row << blocks_down_shift), row_mask)
                # One bit in the first column of every block row covered, ...
                down = (_every_row(last + 1) >> (BLOCKS_ACROSS * first)) << (BLOCKS_ACROSS * first)
                for column in range(left >> 2, (right >> 2) + 1):
                    begin, end = max(left - (column << 2), 0), min(right - (column << 2), column_mask)
                    # ... times the columns covered: one bit per block of the rectangle.
                    across = ((1 << (end - begin + 1)) - 1) << begin
                    tile = row * columns + column
                    place = tallies[chunk, tile]
                    tallies[chunk, tile] = place + 1
                    gaussians[place], blocks[place] = row_index, down * across
                    slots[slot] = place
                    slot += 1


@njit(forceinline=True)
def _every_row(rows):
    """Bit 0 of each of the first `rows` block rows (eight at most, of four bits each)."""
    return 0x11111111 & ((1 << (BLOCKS_ACROSS * rows)) - 1)

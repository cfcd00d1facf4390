"""Depth order and tile lists: a radix sort of float32 depths, then a counting sort into tiles.

Gaussians enter the tiles nearest first, so that no tile has to sort. Both sorts are stable: the lists depend
on the scene only, not on how the work was shared.
"""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.compiling import kernel
from stages.shared.splat.kernels.layout import TILE_SHIFT
from stages.shared.splat.kernels.memory import at, next_item, prefetch

# mypy: ignore-errors
# (compiled and type-checked by numba)

_DIGIT = 11
_BUCKETS = 1 << _DIGIT
_AHEAD = 16


@kernel
def depth_order(keys, counts, first_slots):
    """(rows with counts > 0 in order of `keys`, ties by row; total of counts, -1 if one is negative).

    keys: float32 depths > 0 read as uint32. Also fills first_slots (N + 1,) with the running total of counts:
    where each row's slots begin.
    """
    n = len(keys)
    histogram = np.zeros((3, _BUCKETS), np.int64)
    keys_a, rows_a = np.empty(n, np.uint32), np.empty(n, np.int32)
    visible, total = 0, 0
    for i in range(n):
        first_slots[i] = total
        if counts[i] < 0:
            return rows_a[:0], -1
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
    return rows_a[:visible], total


@kernel
def count_tiles(counter, order, boxes, columns, tile_counts):
    """Entries per tile, chunk of the order by chunk: tallies (chunks, tiles), zeroed before."""
    chunks = len(tile_counts)
    while True:
        chunk = next_item(counter)
        if chunk >= chunks:
            break
        for rank in range(chunk * len(order) // chunks, (chunk + 1) * len(order) // chunks):
            box = 4 * np.int64(at(order, rank))
            left, top = at(boxes, box) >> TILE_SHIFT, at(boxes, box + 1) >> TILE_SHIFT
            right, bottom = at(boxes, box + 2) >> TILE_SHIFT, at(boxes, box + 3) >> TILE_SHIFT
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    tile_counts[chunk, row * columns + column] += 1


@kernel
def place_tiles(tile_counts, starts):
    """Counts per (chunk, tile) -> first place of each, by tile and within by chunk; starts of tiles."""
    place = 0
    for tile in range(tile_counts.shape[1]):
        starts[tile] = place
        for chunk in range(tile_counts.shape[0]):
            size = tile_counts[chunk, tile]
            tile_counts[chunk, tile] = place
            place += size
    starts[tile_counts.shape[1]] = place


@kernel
def fill_tiles(counter, order, boxes, first_slots, columns, tile_counts, gaussians, slots):
    """Write the tile lists: the row of every entry and the slot of its gradient.

    Slots lie Gaussian by Gaussian: written here and there while blending backward, which hides it, they are
    read in order when summed.
    """
    chunks = len(tile_counts)
    while True:
        chunk = next_item(counter)
        if chunk >= chunks:
            break
        stop = (chunk + 1) * len(order) // chunks
        for rank in range(chunk * len(order) // chunks, stop):
            if rank + _AHEAD < stop:
                ahead = np.int64(at(order, rank + _AHEAD))
                prefetch(boxes, 4 * ahead)
                prefetch(first_slots, ahead)
            row_index = np.int64(at(order, rank))
            box, slot = 4 * row_index, np.int64(at(first_slots, row_index))
            left, top = at(boxes, box) >> TILE_SHIFT, at(boxes, box + 1) >> TILE_SHIFT
            right, bottom = at(boxes, box + 2) >> TILE_SHIFT, at(boxes, box + 3) >> TILE_SHIFT
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    tile = row * columns + column
                    place = tile_counts[chunk, tile]
                    tile_counts[chunk, tile] = place + 1
                    gaussians[place] = row_index
                    slots[place] = slot
                    slot += 1

"""Counts the work of blending: the same walk as `blend`, pixel by pixel and slowly."""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.blend import ONE, reached_blocks
from stages.shared.splat.kernels.compiling import kernel
from stages.shared.splat.kernels.falloff import block_corner
from stages.shared.splat.kernels.layout import (
    BLOCK_WIDTH,
    CUT,
    LOG_OPACITY,
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
from stages.shared.splat.kernels.memory import at, lowest_bit, next_item
from stages.shared.splat.settings import ALPHA_MAX, TRANSMITTANCE_MIN

# mypy: ignore-errors
# (compiled and type-checked by numba)


@kernel
def tally(counter, starts, gaussians, records, stride, width, height, constants, lanes, found):
    """found (tiles, 2): pixels blended with a Gaussian, and blocks evaluated, of every tile."""
    count = len(lanes)
    columns = (width + TILE - 1) // TILE
    cut = constants[CUT * count]
    before = np.empty(TILE_PIXELS, np.float32)
    while True:
        tile = next_item(counter)
        if tile >= len(starts) - 1:
            break
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        live = 0
        for block in range(TILE_PIXELS // count):
            corner_x, corner_y = block_corner(block, count, top, left)
            if corner_x < width and corner_y < height:
                live |= 1 << block
            for lane in range(count):
                inside = corner_x + lane % BLOCK_WIDTH < width and corner_y + lane // BLOCK_WIDTH < height
                before[block * count + lane] = 1.0 if inside else -1.0
        pairs, steps = 0, 0
        for entry in range(starts[tile], starts[tile + 1]):
            if live == 0:
                break
            r = gaussians[entry] * stride
            todo = live & reached_blocks(records, r, constants, top, left, lanes)
            while todo != 0:
                block = lowest_bit(todo)
                todo &= todo - 1
                steps += 1
                corner_x, corner_y = block_corner(block, count, top, left)
                any_open = False
                for lane in range(count):
                    here = block * count + lane
                    x = np.float32(corner_x + lane % BLOCK_WIDTH + 0.5) - at(records, r + WHOLE_X)
                    y = np.float32(corner_y + lane // BLOCK_WIDTH + 0.5) - at(records, r + WHOLE_Y)
                    u = at(records, r + UX) * x + (at(records, r + UY) * y + at(records, r + U0))
                    v = at(records, r + VY) * y + at(records, r + V0)
                    exponent = at(records, r + LOG_OPACITY) - u * u - v * v
                    if before[here] > 0 and exponent >= cut:
                        alpha = min(np.float32(2.0**exponent), np.float32(ALPHA_MAX))
                        after = before[here] * (ONE - alpha)
                        if after > TRANSMITTANCE_MIN:
                            pairs += 1
                            before[here] = after
                        else:
                            before[here] = -before[here]
                    any_open |= before[here] > 0
                if not any_open:
                    live &= ~(1 << block)
        found[tile, 0], found[tile, 1] = pairs, steps

"""Projection of Gaussians: records, boxes and depths."""

from __future__ import annotations

import numpy as np

from stages.shared.splat.kernels.compiling import inlined, kernel
from stages.shared.splat.kernels.geometry import (
    ANTIALIASED,
    BOTTOM,
    CUT,
    CX,
    CY,
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
    log2,
    narrow,
    planar_rows,
    product,
    row_of,
    set_row,
    split_center,
    to_camera,
)
from stages.shared.splat.kernels.layout import (
    COLOR,
    DEPTH,
    GROUP,
    GROUPS_PER_TURN,
    LOG_OPACITY,
    TILE_SHIFT,
    U0,
    UX,
    UY,
    V0,
    VY,
    WHOLE_X,
    WHOLE_Y,
)
from stages.shared.splat.kernels.memory import at, next_item, set_at
from stages.shared.splat.kernels.simd import floor, magnitude, maximum, minimum, root, where
from stages.shared.splat.settings import SHORTEST_QUATERNION

# mypy: ignore-errors
# (compiled and type-checked by numba)

REFUSED = np.int32(-1)
"""In `counts`: the Gaussian's numbers cannot be rendered."""

_MARGIN = 1e-3
"""px added to every side of the box, for the rounding of records to float32."""

# Rows of the table after the inputs: a record's fields before the colours, in its order; then the box.
_RECORD = COLOR
_O_LEFT, _O_TOP, _O_RIGHT, _O_BOTTOM = range(FIRST_FREE + _RECORD, FIRST_FREE + _RECORD + 4)
_FORWARD_ROWS = FIRST_FREE + _RECORD + 4


@inlined
def _is_valid(table, place, covars):
    """False for numbers that `scene.check_gaussians` refuses: it then finds out which and why."""
    everything = row_of(table, OPACITY, place)
    for k in range(3):
        everything = everything + row_of(table, MEAN + k, place)
    for k in range(7 if covars is None else 6):
        everything = everything + row_of(table, SHAPE + k, place)
    opacity = row_of(table, OPACITY, place)
    # Zero times a sum of float32 is zero, unless one of them is infinite or not a number.
    fine = (everything * 0.0 >= 0.0) & (opacity >= 0.0) & (opacity <= 1.0)
    if covars is None:
        w, x = magnitude(row_of(table, SHAPE, place)), magnitude(row_of(table, SHAPE + 1, place))
        y, z = magnitude(row_of(table, SHAPE + 2, place)), magnitude(row_of(table, SHAPE + 3, place))
        return fine & (maximum(maximum(w, x), maximum(y, z)) >= SHORTEST_QUATERNION)
    xx, yy, zz = row_of(table, SHAPE, place), row_of(table, SHAPE + 3, place), row_of(table, SHAPE + 5, place)
    return fine & (minimum(minimum(xx, yy), zz) >= 0.0)


@kernel
def project(
    counter, means, quats, scales, covars, opacities, colors, channels, camera, width, height,
    records, stride, boxes, depths, counts,
):  # fmt: skip
    """Gaussians -> records, boxes (4N,) uint16 px inclusive, depths (N,) m, counts (N,) of tiles.

    A count is 0 if the Gaussian is unseen, REFUSED if it cannot be rendered. All arrays are flat. Either
    quats (4N,) and scales (3N,), or covars (9N,); the others None.
    """
    n = len(opacities)
    table = np.empty(_FORWARD_ROWS * GROUP, np.float64)
    per_turn = GROUP * GROUPS_PER_TURN
    while True:
        begin = next_item(counter) * per_turn
        if begin >= n:
            break
        for group in range(begin, min(begin + per_turn, n), GROUP):
            count = min(GROUP, n - group)
            gather(table, group, count, means, quats, scales, covars, opacities)
            for place in range(0, GROUP, WIDE):
                _project_lanes(table, place, camera, covars, width, height)
            for j in range(count):
                g = group + j
                left, right = at(table, _O_LEFT * GROUP + j), at(table, _O_RIGHT * GROUP + j)
                if not left <= right:
                    set_at(counts, g, np.int32(0) if left < 2.0 else REFUSED)
                    continue
                top, bottom = at(table, _O_TOP * GROUP + j), at(table, _O_BOTTOM * GROUP + j)
                record = g * stride
                for k in range(_RECORD):
                    set_at(records, record + k, at(table, (FIRST_FREE + k) * GROUP + j))
                set_at(depths, g, at(records, record + DEPTH))
                for c in range(channels):
                    set_at(records, record + COLOR + c, at(colors, g * channels + c))
                left, top, right, bottom = int(left), int(top), int(right), int(bottom)
                set_at(boxes, 4 * g, np.uint16(left))
                set_at(boxes, 4 * g + 1, np.uint16(top))
                set_at(boxes, 4 * g + 2, np.uint16(right))
                set_at(boxes, 4 * g + 3, np.uint16(bottom))
                across = (right >> TILE_SHIFT) - (left >> TILE_SHIFT) + 1
                set_at(counts, g, np.int32(across * ((bottom >> TILE_SHIFT) - (top >> TILE_SHIFT) + 1)))


@inlined
def _project_lanes(table, place, camera, covars, width, height):
    x, y, z = to_camera(table, place, camera)
    inside = (z > camera[NEAR]) & (z < camera[FAR])
    inverse_z = 1.0 / where(inside, z, 1.0)
    u, v = x * inverse_z, y * inverse_z
    center_x, center_y = u * camera[FX] + camera[CX], v * camera[FY] + camera[CY]
    u = minimum(maximum(u, camera[LEFT]), camera[RIGHT])
    v = minimum(maximum(v, camera[TOP]), camera[BOTTOM])
    row_x, row_y = planar_rows(camera, inverse_z, u, v)
    covariance = covariance_of(table, place, covars)
    through_x, through_y = product(covariance, row_x), product(covariance, row_y)
    sharp_xx, sharp_yy = maximum(dot(row_x, through_x), 0.0), maximum(dot(row_y, through_y), 0.0)
    xy, _ = narrow(sharp_xx, dot(row_x, through_y), sharp_yy)
    xx, yy = sharp_xx + camera[EPS2D], sharp_yy + camera[EPS2D]
    sharp = maximum(sharp_xx * sharp_yy - xy * xy, 0.0)
    determinant = blurred(sharp, sharp_xx + sharp_yy, camera[EPS2D])
    opacity = row_of(table, OPACITY, place)
    if camera[ANTIALIASED] > 0:
        opacity = opacity * root(sharp / determinant)
    log_opacity = log2(maximum(opacity, 1e-30))
    # u^2 + v^2 <= reach is the ellipse on which alpha falls to the cut.
    reach = log_opacity - camera[CUT]
    sides = maximum(reach, 0.0) * (1.0 / HALF_LOG2E)
    across, down = root(sides * xx) + _MARGIN, root(sides * yy) + _MARGIN
    left = maximum(0.0 - floor(0.0 - (center_x - across - 0.5)), 0.0)
    right = minimum(floor(center_x + across - 0.5), width - 1.0)
    top = maximum(0.0 - floor(0.0 - (center_y - down - 0.5)), 0.0)
    bottom = minimum(floor(center_y + down - 0.5), height - 1.0)
    seen = inside & (reach >= 0.0) & (left <= right) & (top <= bottom)
    whole_x, rest_x = split_center(center_x)
    whole_y, rest_y = split_center(center_y)
    set_row(table, FIRST_FREE + WHOLE_X, place, whole_x)
    set_row(table, FIRST_FREE + WHOLE_Y, place, whole_y)
    shared = root(HALF_LOG2E / (determinant * yy))
    ux, u_y, vy = yy * shared, 0.0 - xy * shared, root(HALF_LOG2E / yy)
    set_row(table, FIRST_FREE + UX, place, ux)
    set_row(table, FIRST_FREE + UY, place, u_y)
    set_row(table, FIRST_FREE + U0, place, 0.0 - ux * rest_x - u_y * rest_y)
    set_row(table, FIRST_FREE + VY, place, vy)
    set_row(table, FIRST_FREE + V0, place, 0.0 - vy * rest_y)
    set_row(table, FIRST_FREE + LOG_OPACITY, place, log_opacity)
    set_row(table, FIRST_FREE + DEPTH, place, z)
    # left > right says unseen; left = 2 as well, refused.
    fine = _is_valid(table, place, covars)
    set_row(table, _O_LEFT, place, where(fine, where(seen, left, 1.0), 2.0))
    set_row(table, _O_RIGHT, place, where(fine & seen, right, 0.0))
    set_row(table, _O_TOP, place, top)
    set_row(table, _O_BOTTOM, place, bottom)

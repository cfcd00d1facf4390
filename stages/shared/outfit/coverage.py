"""Which body texels a garment covers: a geometric test on the shared grid of texels.

A body texel is covered when a sheet of the garment that faces the same side contains it (the sheet slightly
dilated, its holes filled), and the garment's point lies outside the body along the body's normal. Gaussian
Wardrobe swaps "Gaussians inside the garment"; this test decides which those are, without painted masks.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from stages.shared.avatar.maps import LayerMaps

DILATION = 0.008  # m that a garment reaches beyond its own texels
FEATHER = 0.020  # m over which covered fades to uncovered
_INNERMOST, _OUTERMOST = -0.015, 0.15  # m of the garment above the skin; fits let skin poke through a little


def same_grid(one: LayerMaps, other: LayerMaps) -> bool:
    """Whether texels of both mean the same places."""
    close = np.allclose(one.centre, other.centre, atol=1e-5) and abs(one.pitch - other.pitch) < 1e-9
    return one.grid_size == other.grid_size and bool(close)


def covered_weights(body: LayerMaps, garment: LayerMaps, feather: float = FEATHER) -> NDArray[np.float32]:
    """How much each body texel is covered: (N,) f32, 0 bare, 1 fully covered, feathered between.

    Arguments:
        body, garment: maps; on different grids nothing is covered. feather: metres; 0 for a hard edge.
    """
    weights = np.zeros(len(body), np.float32)
    if not same_grid(body, garment):
        return weights
    texels, window = body.texels.numpy(), garment.window
    reach = int(np.ceil(DILATION / body.pitch)) + 1
    row0, column0 = window[0] - reach, window[1] - reach
    height, width = window[2] + 2 * reach, window[3] + 2 * reach
    for view in range(body.views):
        rows, columns = texels[:, 1] - row0, texels[:, 2] - column0
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        member = np.flatnonzero((texels[:, 0] == view) & inside)
        rows, columns = rows[member], columns[member]
        covered = np.zeros((height, width), bool)
        for sheet in range(view % 2, garment.views, 2):
            covered[rows, columns] |= _covered(
                body, garment, sheet, member, rows, columns, (row0, column0, height, width)
            )
        weights[member] = _feathered(covered, rows, columns, body.pitch, feather)
    return weights


def _covered(
    body: LayerMaps,
    garment: LayerMaps,
    sheet: int,
    member: NDArray[np.intp],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    window: tuple[int, int, int, int],
) -> NDArray[np.bool_]:
    """(M,) which body texels `member` a sheet of the garment covers; rows and columns in the window."""
    row0, column0, height, width = window
    texels = garment.texels.numpy()
    here = np.flatnonzero(texels[:, 0] == sheet)
    if not len(here) or not len(member):
        return np.zeros(len(member), bool)
    index = np.full((height, width), -1, np.int64)
    index[texels[here, 1] - row0, texels[here, 2] - column0] = here
    far, nearest = ndimage.distance_transform_edt(index < 0, return_indices=True)
    mask = ndimage.binary_fill_holes(far <= DILATION / garment.pitch)
    above = garment.positions.numpy()[index[nearest[0], nearest[1]]][rows, columns]
    height_above = np.einsum("nk,nk->n", above - body.positions.numpy()[member], body.normals.numpy()[member])
    return mask[rows, columns] & (height_above > _INNERMOST) & (height_above < _OUTERMOST)


def _feathered(
    covered: NDArray[np.bool_],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    pitch: float,
    feather: float,
) -> NDArray[np.float32]:
    """(M,) weights of the body texels of one view: 0 at the edge of the covered part, 1 `feather` m inside.

    The edge of the body map does not count as an edge: the surface continues in the other view.
    """
    body = np.zeros(covered.shape, bool)
    body[rows, columns] = True
    closed = (
        cv2.morphologyEx((covered | ~body).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    )
    if feather <= 0:
        return (closed & body)[rows, columns].astype(np.float32)
    bare = body & ~closed
    if not bare.any():
        return np.ones(len(rows), np.float32)
    distance = ndimage.distance_transform_edt(~bare)[rows, columns] * pitch
    return np.clip((distance - pitch) / feather, 0, 1).astype(np.float32) * closed[rows, columns]

"""Colours for the texels of a garment that no image shows: the fabric goes on.

The front and the back map are laid side by side, and a shift-map search (Pritch, Kav-Venaki and Peleg 2009,
as in OpenCV's xphoto) copies seen texels into the unseen region so that stripes, dots and checks continue.
Texels on peeled sheets take the colour of the nearest texel on the two outer sheets.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps

_LEAST_SOURCE = 64  # seen texels; fewer are no pattern, and the unseen ones take their median
_MOST_PIXELS = 600_000  # of the two maps together; a larger search would take minutes
_PASSES = 4
_SEED = 7  # of OpenCV's generator: the same maps give the same colours


def continue_fabric(maps: LayerMaps, colors: Tensor, seen: NDArray[np.bool_]) -> Tensor:
    """Colours (N, 3) sRGB 0..1: those of seen texels as they are, the others continued from them.

    Arguments:
        maps: of the layer. colors: (N, 3) sRGB 0..1. seen: (N,) bool.
    """
    if seen.all() or not seen.any():
        return colors
    values = colors.detach().cpu().numpy().astype(np.float32)
    filled = np.where(seen[:, None], values, np.median(values[seen], axis=0))
    outer = maps.texels[:, 0].cpu().numpy() < 2
    height, width = maps.window[2], maps.window[3]
    if (seen & outer).sum() >= _LEAST_SOURCE and 2 * height * width <= _MOST_PIXELS:
        place = _canvas_places(maps)
        canvas = np.zeros((height, 2 * width + 1, 3), np.uint8)
        inside, source = np.zeros(canvas.shape[:2], bool), np.zeros(canvas.shape[:2], bool)
        row, column = place[outer].T
        canvas[row, column] = np.rint(255 * values[outer].clip(0, 1))
        inside[row, column] = True
        source[row, column] = seen[outer]
        # A seen texel next to an unseen one is often half covered itself: it stays, but is no source.
        interior = ndimage.binary_erosion(source | ~inside, np.ones((3, 3))) & source
        if interior.sum() >= _LEAST_SOURCE:
            canvas = _shift_map(canvas, inside, interior)
            found = canvas[row, column].astype(np.float32) / 255
            filled[outer] = np.where(seen[outer, None], values[outer], found)
    _from_outer_sheets(maps, filled, seen, outer)
    return torch.from_numpy(filled).to(colors)


def _canvas_places(maps: LayerMaps) -> NDArray[np.int64]:
    """(N, 2) row and column of every texel: the front on the left, the back mirrored on the right."""
    view, row, column = (part.cpu().numpy() for part in maps.window_texels)
    width = maps.window[3]
    return np.stack([row, np.where(view % 2 == 0, column, 2 * width - column)], axis=1)


def _shift_map(
    image: NDArray[np.uint8], inside: NDArray[np.bool_], source: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """The image (H, W, 3) u8 sRGB with everything inside filled by copies of source pixels.

    The search may leave some pixels without a copy; they are searched for again among those that have one.
    """
    current = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2Lab), np.uint8)
    for _ in range(_PASSES):
        if (inside & ~source).sum() == 0:
            break
        cv2.setRNGSeed(_SEED)
        answer = np.zeros_like(current)
        valid = np.where(source, 255, 0).astype(np.uint8)
        cv2.xphoto.inpaint(current, valid, answer, cv2.xphoto.INPAINT_SHIFTMAP)
        copied = np.isin(_packed(answer), np.unique(_packed(current[source])))
        current = np.where(source[..., None], current, answer)
        source = source | (inside & copied)
    left = inside & ~source
    if left.any():
        nearest = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
        current[left] = current[tuple(nearest[:, left])]
    return np.asarray(cv2.cvtColor(current, cv2.COLOR_Lab2RGB), np.uint8)


def _packed(pixels: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(...,) one number per pixel (..., 3)."""
    return pixels.astype(np.int64) @ np.array([65536, 256, 1])


def _from_outer_sheets(
    maps: LayerMaps, filled: NDArray[np.float32], seen: NDArray[np.bool_], outer: NDArray[np.bool_]
) -> None:
    """Give unseen texels of peeled sheets the colour of the nearest one of the two outer sheets, in place."""
    inner = ~outer & ~seen
    if inner.any() and outer.any():
        positions = maps.positions.cpu().numpy()
        _, nearest = cKDTree(positions[outer]).query(positions[inner])
        filled[inner] = filled[np.flatnonzero(outer)[nearest]]

"""Texels of a garment that no image shows: the fabric continues, as discs that cover the surface.

The front and the back map are laid side by side. From the border inwards, each unseen texel takes the colour
of the seen texel whose surroundings are most like its own, so that stripes, dots and checks continue. This is
non-parametric sampling (Efros and Leung 1999) with the best match instead of a random good one. OpenCV's
`xphoto` has a faster search, but it does not always give the same bytes. Texels on peeled sheets take the
colour of the nearest texel on the two outer sheets.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.maps import LayerMaps

_LEAST_SOURCE = 64  # seen texels; fewer are no pattern, and the unseen ones take their median
_PATCH = 0.06  # m, side of the patches that are compared: about a period of a pattern
_MOST_PATCHES = 4096
_COVER = 0.75  # standard deviation of a disc per distance to its neighbours; covers 98 % between them
_LONGEST = 2.0  # pitches; at the rim of a limb, longer discs would stand out from it
_FLATNESS = 0.3
_OPACITY = 0.97


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
    if (seen & outer).sum() >= _LEAST_SOURCE:
        height, width = maps.window[2], maps.window[3]
        row, column = _canvas_places(maps)[outer].T
        canvas = np.zeros((height, 2 * width + 1, 3), np.float32)
        inside, source = np.zeros(canvas.shape[:2], bool), np.zeros(canvas.shape[:2], bool)
        canvas[row, column] = values[outer]
        inside[row, column] = True
        source[row, column] = seen[outer]
        # A seen texel next to an unseen one is often half covered itself: it stays, but is no source.
        interior = ndimage.binary_erosion(source | ~inside, np.ones((3, 3))) & source
        if interior.sum() >= _LEAST_SOURCE:
            half = int(np.clip(round(_PATCH / 2 / maps.pitch), 2, 5))
            _fill_by_exemplars(canvas, interior.copy(), inside, _patch_centres(interior, half), half)
            filled[outer] = np.where(seen[outer, None], values[outer], canvas[row, column])
    _from_outer_sheets(maps, filled, seen, outer)
    return torch.from_numpy(filled).to(colors)


def _patch_centres(source: NDArray[np.bool_], half: int) -> NDArray[np.int64]:
    """(S, 2) centres of source patches, at most `_MOST_PATCHES`: whole ones, or any where few are whole."""
    whole = ndimage.binary_erosion(source, np.ones((2 * half + 1, 2 * half + 1)))
    centres = np.argwhere(whole if whole.sum() >= _LEAST_SOURCE else source)
    return np.ascontiguousarray(centres[:: -(-len(centres) // _MOST_PATCHES)])


def _canvas_places(maps: LayerMaps) -> NDArray[np.int64]:
    """(N, 2) row and column of every texel: the front on the left, the back mirrored on the right."""
    view, row, column = (part.cpu().numpy() for part in maps.window_texels)
    width = maps.window[3]
    return np.stack([row, np.where(view % 2 == 0, column, 2 * width - column)], axis=1)


@njit(cache=True, nogil=True)
def _fill_by_exemplars(image, known, inside, sources, half):  # type: ignore[no-untyped-def]
    """Fill unknown pixels inside, in place, from the border inwards.

    Each takes the colour at the centre of the source patch that is most like the known part of its own patch.

    Arguments:
        image: (H, W, 3) f32. known: (H, W) bool, becomes `inside`. inside: (H, W) bool.
        sources: (S, 2) i64 centres of source patches. half: patches have 2 half + 1 pixels a side.
    """
    height, width = known.shape
    source_known = known.copy()
    while True:
        border = np.zeros((height * width, 3), np.int64)  # −known pixels of the patch, row, column
        count = 0
        for row in range(height):
            for column in range(width):
                if known[row, column] or not inside[row, column]:
                    continue
                near, votes = 0, 0
                for y in range(max(row - half, 0), min(row + half + 1, height)):
                    for x in range(max(column - half, 0), min(column + half + 1, width)):
                        if known[y, x]:
                            votes += 1
                            if abs(y - row) <= 1 and abs(x - column) <= 1:
                                near += 1
                if near > 0:
                    border[count] = (-votes, row, column)
                    count += 1
        if count == 0:  # done, or a part of the map without a seen texel: it starts with one source texel
            for row in range(height):
                for column in range(width):
                    if count == 0 and inside[row, column] and not known[row, column]:
                        border[0] = (0, row, column)
                        count = 1
            if count == 0:
                return
        for place in np.argsort(border[:count, 0], kind="mergesort"):
            row, column = border[place, 1], border[place, 2]
            best, best_error = -1, np.inf
            for number in range(len(sources)):
                down, right = sources[number, 0] - row, sources[number, 1] - column
                error, pairs, asked = 0.0, 0, 0
                for y in range(max(row - half, 0), min(row + half + 1, height)):
                    for x in range(max(column - half, 0), min(column + half + 1, width)):
                        if not known[y, x]:
                            continue
                        asked += 1
                        v, u = y + down, x + right
                        if v < 0 or v >= height or u < 0 or u >= width or not source_known[v, u]:
                            continue
                        pairs += 1
                        for channel in range(3):
                            difference = image[y, x, channel] - image[v, u, channel]
                            error += difference * difference
                if 4 * pairs >= 3 * asked and error < best_error * pairs:
                    best, best_error = number, error / pairs
            if best < 0:
                best = 0
            for channel in range(3):
                image[row, column, channel] = image[sources[best, 0], sources[best, 1], channel]
            known[row, column] = True


def _from_outer_sheets(
    maps: LayerMaps, filled: NDArray[np.float32], seen: NDArray[np.bool_], outer: NDArray[np.bool_]
) -> None:
    """Give unseen texels of peeled sheets the colour of the nearest one of the two outer sheets, in place."""
    inner = ~outer & ~seen
    if inner.any() and outer.any():
        positions = maps.positions.cpu().numpy()
        _, nearest = cKDTree(positions[outer]).query(positions[inner])
        filled[inner] = filled[np.flatnonzero(outer)[nearest]]


def covering_discs(maps: LayerMaps) -> tuple[Tensor, Tensor, Tensor]:
    """Quaternions (N, 4), scales (N, 3) m and opacities (N,) of discs that cover the surface they lie in.

    Texels are one pitch apart on the map, and farther apart where the surface slopes away. The size of a disc
    along each axis is the distance to its neighbours along it.
    """
    import roma  # loads the whole of torch._dynamo: two seconds

    normals = functional.normalize(maps.normals, dim=1)
    down = normals.new_tensor([0.0, 0.0, 1.0]) - normals[:, 2:] * normals
    flat = down.norm(dim=1, keepdim=True) < 1e-3  # facing front or back: any direction will do
    down = functional.normalize(torch.where(flat, normals.new_tensor([1.0, 0.0, 0.0]), down), dim=1)
    across = functional.normalize(torch.linalg.cross(normals, down), dim=1)
    axes = torch.stack((torch.linalg.cross(across, normals), across, normals), dim=2)
    first, second = (torch.from_numpy(end) for end in maps.links())
    away = ((maps.positions[second] - maps.positions[first])[:, None] @ axes[first, :, :2])[:, 0].abs()
    ahead = functional.one_hot(away.argmax(dim=1), 2) * (away > 0)  # the axis that a neighbour lies on
    count = away.new_zeros(len(maps), 2).index_add(0, first, ahead.to(away))
    total = away.new_zeros(len(maps), 2).index_add(0, first, ahead * away)
    spacing = torch.where(count > 0, total / count.clamp(min=1), maps.pitch).clamp(max=_LONGEST * maps.pitch)
    thickness = _FLATNESS * spacing.min(dim=1, keepdim=True).values
    quaternions = roma.rotmat_to_unitquat(axes)[:, [3, 0, 1, 2]]
    scales = _COVER * torch.cat((spacing, thickness), dim=1)
    return quaternions, scales, torch.full_like(maps.spacing, _OPACITY)

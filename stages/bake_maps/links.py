"""Which texels are neighbours on the surface, which meet across the silhouette, how far apart they are."""

from __future__ import annotations

import numpy as np

_STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up right down left, in rows and columns


def texel_numbers(texels: np.ndarray, window: tuple[int, int, int, int], views: int = 2) -> np.ndarray:
    """(views, height, width) int32: number of the texel at each pixel of the window, −1 where none."""
    row0, column0, height, width = window
    numbers = np.full((views, height, width), -1, dtype=np.int32)
    numbers[texels[:, 0], texels[:, 1] - row0, texels[:, 2] - column0] = np.arange(len(texels))
    return numbers


def neighbour_texels(
    numbers: np.ndarray,
    texels: np.ndarray,
    window: tuple[int, int, int, int],
    depths: np.ndarray,
    jump: float,
) -> np.ndarray:
    """(N, 4) int32: the texel up, right, down, left that faces the same side, −1 where none or a depth jump.

    Of several sheets the one nearest in depth counts, so a surface stays linked where it goes beneath
    another. Links are mutual.

    Arguments:
        numbers: (views, height, width). texels: (N, 3). depths: (N,) metres along z. jump: metres.
    """
    padded = np.pad(numbers, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    side, row, column = texels[:, 0] % 2, texels[:, 1] - window[0] + 1, texels[:, 2] - window[1] + 1
    sheets = padded.reshape(-1, 2, *padded.shape[1:])  # sheet, side
    found = np.full((len(texels), 4), -1, dtype=np.int32)
    for direction, (down, across) in enumerate(_STEPS):
        beside = sheets[:, side, row + down, column + across]  # (sheets, N)
        distance = np.where(beside >= 0, np.abs(depths[beside] - depths), np.inf)
        nearest = distance.argmin(axis=0)[None]
        near = np.take_along_axis(distance, nearest, axis=0)[0] <= jump
        found[:, direction] = np.where(near, np.take_along_axis(beside, nearest, axis=0)[0], -1)
    for direction in range(2):
        _keep_mutual(found, direction, direction + 2)
    return found


def _keep_mutual(found: np.ndarray, direction: int, opposite: int) -> None:
    """Drop, in place, links that the other end does not return."""
    ends = {way: found[:, way].copy() for way in (direction, opposite)}
    for way, back in ((direction, opposite), (opposite, direction)):
        linked = np.flatnonzero(ends[way] >= 0)
        lost = linked[ends[back][ends[way][linked]] != linked]
        found[lost, way] = -1


def seam_pairs(
    numbers: np.ndarray,
    neighbours: np.ndarray,
    positions: np.ndarray,
    normals: np.ndarray,
    reach: float,
    fold: float = 0.0,
) -> np.ndarray:
    """(S, 2) int32: texels of one pixel, one facing front and one back, where the surface turns around.

    Both lie on the rim of their sheet (a neighbour is missing). What is met first from both sides must lie
    within `reach`, and either the normals agree sideways (the surface turns there) or they nearly touch
    (finger tips, thin cloth). Rims of an opening, such as a hem, face opposite ways and are not joined. A
    peeled texel is joined at a crease no deeper than `fold` metres.

    Arguments:
        numbers: (views, height, width). neighbours: (N, 4). positions: (N, 3) metres. normals: (N, 3) unit.
    """
    rim = np.any(neighbours < 0, axis=1)
    pairs = []
    for front_view in range(0, len(numbers), 2):
        for back_view in range(1, len(numbers), 2):
            front, back = numbers[front_view].ravel(), numbers[back_view].ravel()
            both = (front >= 0) & (back >= 0)
            front, back = front[both], back[both]
            distance = np.linalg.norm(positions[front] - positions[back], axis=1)
            turns = np.einsum("sk,sk->s", normals[front, :2], normals[back, :2]) > 0.2
            if front_view + back_view == 1:
                near = (turns & (distance < reach)) | (distance < reach / 8)
            else:
                near = turns & (distance < fold)
            meets = rim[front] & rim[back] & near
            pairs.append(np.stack([front[meets], back[meets]], axis=1))
    return np.concatenate(pairs).astype(np.int32)


def initial_sigma(
    normals: np.ndarray, pitch: float, per_spacing: float, largest_stretch: float
) -> np.ndarray:
    """(N,) metres: standard deviation that lets a texel's Gaussian blend with the next ones.

    A texel covers pitch / |n_z| of a surface with unit normal n (N, 3) along its slope; that is its spacing,
    at most `largest_stretch` pitches.
    """
    stretch = 1.0 / np.maximum(np.abs(normals[:, 2]), 1.0 / largest_stretch)
    return per_spacing * pitch * stretch

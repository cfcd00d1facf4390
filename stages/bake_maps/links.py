"""Which texels are neighbours on the surface, which meet across the silhouette, how far apart they are."""

from __future__ import annotations

import numpy as np

_STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up right down left, in rows and columns


def texel_numbers(texels: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
    """(2, height, width) int32: number of the texel at each pixel of the window, −1 where there is none."""
    row0, column0, height, width = window
    numbers = np.full((2, height, width), -1, dtype=np.int32)
    numbers[texels[:, 0], texels[:, 1] - row0, texels[:, 2] - column0] = np.arange(len(texels))
    return numbers


def neighbour_texels(
    numbers: np.ndarray,
    texels: np.ndarray,
    window: tuple[int, int, int, int],
    depths: np.ndarray,
    jump: float,
) -> np.ndarray:
    """(N, 4) int32: the texel up, right, down, left in the same view, −1 where none or across a depth jump.

    Arguments:
        numbers: (2, height, width). texels: (N, 3). depths: (N,) metres along z. jump: metres.
    """
    padded = np.pad(numbers, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    view, row, column = texels[:, 0], texels[:, 1] - window[0] + 1, texels[:, 2] - window[1] + 1
    found = np.stack([padded[view, row + down, column + across] for down, across in _STEPS], axis=1)
    far = np.abs(depths[found] - depths[:, None]) > jump
    return np.where((found >= 0) & far, -1, found).astype(np.int32)


def seam_pairs(
    numbers: np.ndarray, neighbours: np.ndarray, positions: np.ndarray, normals: np.ndarray, reach: float
) -> np.ndarray:
    """(S, 2) int32: front and back texels of one pixel that meet across the silhouette.

    Both lie on the rim of their view (a neighbour is missing) and within `reach`, and either their normals
    agree sideways (the surface turns around there) or they nearly touch (finger tips, thin cloth). Rims
    of an opening, such as a hem, face opposite ways and are not joined.
    """
    front, back = numbers[0].ravel(), numbers[1].ravel()
    both = (front >= 0) & (back >= 0)
    front, back = front[both], back[both]
    rim = np.any(neighbours < 0, axis=1)
    distance = np.linalg.norm(positions[front] - positions[back], axis=1)
    turns = np.einsum("sk,sk->s", normals[front, :2], normals[back, :2]) > 0.2
    meets = rim[front] & rim[back] & ((turns & (distance < reach)) | (distance < reach / 8))
    return np.stack([front[meets], back[meets]], axis=1).astype(np.int32)


def initial_sigma(
    normals: np.ndarray, pitch: float, per_spacing: float, largest_stretch: float
) -> np.ndarray:
    """(N,) metres: standard deviation that lets a texel's Gaussian blend with the next ones.

    A texel covers pitch / |n_z| of a surface with unit normal n (N, 3) along its slope; that is its spacing,
    at most `largest_stretch` pitches.
    """
    stretch = 1.0 / np.maximum(np.abs(normals[:, 2]), 1.0 / largest_stretch)
    return per_spacing * pitch * stretch

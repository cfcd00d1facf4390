"""The texel maps of a layer: which arrays they have, and how texels are linked to each other.

A texel is one pixel of a map with a surface point behind it. It carries one Gaussian. `ARRAYS` states name,
shape, type, unit and range of every array. Bake-maps writes them, `LayerMaps` holds them as tensors, and a
bundle carries them as `maps/…`. Imports numpy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

MAX_VIEWS: Final = 32  # front and back, and the sheets peeled off below them
BOX: Final = 2.0  # metres: no canonical point is farther from the origin along an axis
_STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up right down left, in rows and columns


class TexelArray(NamedTuple):
    """An array with one row per texel.

    Attributes:
        shape: of one row. kind: "i" for int32 or "f" for float32. about: meaning and unit.
        low, high: smallest and largest value that is accepted from a file.
        half: a bundle may store it with 16 bits.
    """

    shape: tuple[int, ...]
    kind: str
    about: str
    low: float = -np.inf
    high: float = np.inf
    half: bool = False


ARRAYS: Final[dict[str, TexelArray]] = {
    "texels": TexelArray((3,), "i", "view, row, column on the grid (N,3)"),
    "positions": TexelArray((3,), "f", "m canonical zero-shape (N,3)", -BOX, BOX),
    "normals": TexelArray((3,), "f", "unit canonical (N,3)", -1.01, 1.01, half=True),
    "skin_weights": TexelArray((55,), "f", "rows sum to 1 (N,55)", -1e-6, 1.01, half=True),
    "shape_directions": TexelArray((10, 3), "f", "m per unit of shape, canonical (N,10,3)", -1, 1, half=True),
    "neighbours": TexelArray((4,), "i", "texel up, right, down, left; -1 none (N,4)"),
    "spacing": TexelArray((), "f", "m, initial standard deviation (N,)", 1e-6, 1),
    "colors": TexelArray((3,), "f", "sRGB 0..1 (N,3)", -0.01, 1.01, half=True),
    "color_confidence": TexelArray((), "f", "cosine of the best view, 0 where filled (N,)", 0, 2, half=True),
}
FLOATS: Final = tuple(name for name, array in ARRAYS.items() if array.kind == "f")
OTHER_ARRAYS: Final[dict[str, str]] = {  # int32, without a row per texel
    "window": "row0, column0, height, width (4,)",
    "seams": "texel facing front, texel facing back (S,2)",
}


def index_problem(arrays: Mapping[str, np.ndarray], grid_size: int) -> tuple[str, str] | None:
    """What is wrong with the indices of maps, and in which array; None if nothing is wrong.

    The shapes must be right already.
    """
    texels, count = arrays["texels"], len(arrays["texels"])
    row, column, height, width = (int(value) for value in arrays["window"])
    if min(row, column) < 0 or min(height, width) < 0 or max(row + height, column + width) > grid_size:
        return "the window lies outside the grid", "window"
    low, high = np.array([0, row, column]), np.array([MAX_VIEWS, row + height, column + width])
    if (texels < low).any() or (texels >= high).any():
        return "a texel lies outside the window", "texels"
    for name, lowest in (("neighbours", -1), ("seams", 0)):
        if (arrays[name] < lowest).any() or (arrays[name] >= count).any():
            return "the index of a texel does not exist", name
    return None


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

    Of several sheets the one nearest in depth counts, so a surface stays linked where it goes under
    another. Links are mutual.

    Arguments:
        numbers: (views, height, width). texels: (N, 3). depths: (N,) metres along z. jump: metres.
    """
    padded = np.pad(numbers, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
    side, row, column = texels[:, 0] % 2, texels[:, 1] - window[0] + 1, texels[:, 2] - window[1] + 1
    sheets = padded.reshape(-1, 2, *padded.shape[1:])  # sheet, side
    neighbours = np.full((len(texels), 4), -1, dtype=np.int32)
    for direction, (down, across) in enumerate(_STEPS):
        adjacent = sheets[:, side, row + down, column + across]  # (sheets, N)
        distance = np.where(adjacent >= 0, np.abs(depths[adjacent] - depths), np.inf)
        nearest = distance.argmin(axis=0)[None]
        near = np.take_along_axis(distance, nearest, axis=0)[0] <= jump
        neighbours[:, direction] = np.where(near, np.take_along_axis(adjacent, nearest, axis=0)[0], -1)
    for direction in range(2):
        _drop_one_way(neighbours, direction, direction + 2)
    return neighbours


def _drop_one_way(neighbours: np.ndarray, direction: int, opposite: int) -> None:
    """Drop, in place, links that the other end does not return."""
    ends = {way: neighbours[:, way].copy() for way in (direction, opposite)}
    for way, back in ((direction, opposite), (opposite, direction)):
        linked = np.flatnonzero(ends[way] >= 0)
        lost = linked[ends[back][ends[way][linked]] != linked]
        neighbours[lost, way] = -1


def texel_links(neighbours: np.ndarray, seams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both ends (K,) of every link between texels, on the map or along a seam: each link in both directions.

    Arguments:
        neighbours: (N, 4) texel on each side, −1 where none. seams: (S, 2).
    """
    start, side = np.nonzero(neighbours >= 0)
    first = np.concatenate([start, seams[:, 0], seams[:, 1]])
    second = np.concatenate([neighbours[start, side], seams[:, 1], seams[:, 0]])
    return first, second


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

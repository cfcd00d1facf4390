"""The maps as a picture: colours above, normals below; front, back, peeled sheets; a column per layer."""

from __future__ import annotations

import numpy as np

from stages.bake_maps.texels import Texels

_GAP = 6


def maps_picture(layers: list[tuple[Texels, np.ndarray, np.ndarray]]) -> np.ndarray:
    """(H, W, 3) u8 from, per layer, its texels, colours (N, 3) 0..1 and normals (N, 3)."""
    columns = []
    for texels, colors, normals in layers:
        images = [_image(texels, values) for values in (colors, 0.5 + 0.5 * normals)]
        columns.append(np.concatenate([_framed(image) for image in images], axis=0))
    height = max(column.shape[0] for column in columns)
    padded = [
        np.pad(column, ((0, height - len(column)), (0, 0), (0, 0)), constant_values=255) for column in columns
    ]
    return np.concatenate(padded, axis=1)


def _image(texels: Texels, values: np.ndarray) -> np.ndarray:
    """(height, views · width, 3) u8: front, back, peeled sheets, of values (N, 3) 0..1 on white."""
    row0, column0, height, width = texels.window
    image = np.full((texels.views, height, width, 3), 255, np.uint8)
    view, row, column = texels.texels.T
    image[view, row - row0, column - column0] = np.rint(255 * np.clip(values, 0, 1))
    return np.concatenate(list(image), axis=1)


def _framed(image: np.ndarray) -> np.ndarray:
    return np.pad(image, ((_GAP, _GAP), (_GAP, _GAP), (0, 0)), constant_values=255)

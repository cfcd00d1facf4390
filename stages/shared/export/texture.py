"""The texel maps of a layer as one texture, and the place of its template mesh on it.

The sheets of the maps (front, back, and what was peeled off below) stand side by side in the picture. Every
face lies on the sheet that shows it, so vertices where the sheet changes are doubled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from stages.shared.avatar.maps import LayerMaps
from stages.shared.meshes.topology import face_normals
from stages.shared.texel_maps import texel_numbers

_MARGIN = 2  # texels around every sheet, so that neighbouring sheets do not mix when the texture is filtered
_WRONG_SIDE = 3.0  # pitches of depth that a face rather goes than lie on a sheet that faces the other way


@dataclass(frozen=True, eq=False)
class MeshTexture:
    """A texture and the unwrapped mesh.

    Attributes:
        image: (H, W, 3) u8 sRGB.
        vertex: (U,) vertex of the mesh that each unwrapped vertex is. faces: (F, 3) unwrapped vertices.
        uvs: (U, 2) f32, 0..1 from the left and from the top, as glTF has them.
    """

    image: NDArray[np.uint8]
    vertex: NDArray[np.int64]
    faces: NDArray[np.int32]
    uvs: NDArray[np.float32]


def mesh_texture(
    maps: LayerMaps,
    colors: NDArray[np.floating],
    vertices: NDArray[np.floating],
    faces: NDArray[np.int32],
) -> MeshTexture:
    """The maps as a texture of a mesh.

    Arguments:
        colors: (N, 3) sRGB 0..1 of the texels.
        vertices: (V, 3) m, canonical, of zero shape, as the maps are. faces: (F, 3).
    """
    texels, positions = maps.texels.cpu().numpy(), maps.positions.cpu().numpy()
    numbers = np.pad(texel_numbers(texels, maps.window, maps.views), ((0, 0), (_MARGIN,) * 2, (_MARGIN,) * 2),
                     constant_values=-1)  # fmt: skip
    nearest, distance = np.empty_like(numbers), np.empty(numbers.shape)
    for view, sheet in enumerate(numbers):
        if not (sheet >= 0).any():
            nearest[view], distance[view] = 0, np.inf
            continue
        distance[view], (row, column) = distance_transform_edt(sheet < 0, return_indices=True)
        nearest[view] = sheet[row, column]
    image = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)[nearest]
    places = _on_sheet(maps, vertices, numbers.shape)

    centres, middles = vertices[faces].mean(axis=1), places[faces].mean(axis=1).astype(int)
    column, row = middles.T
    depth = positions[nearest[:, row, column], 2] - centres[:, 2]  # (views, F)
    sides = np.arange(len(numbers)) % 2
    wrong = sides[:, None] != (face_normals(vertices, faces)[0][:, 2] < 0)
    cost = np.abs(depth) + maps.pitch * (distance[:, row, column] + _WRONG_SIDE * wrong)
    view = cost.argmin(axis=0)  # (F,)

    corners, unwrapped = np.unique(faces.astype(np.int64) * len(numbers) + view[:, None], return_inverse=True)
    vertex, sheet = np.divmod(corners, len(numbers))
    height, width = numbers.shape[1:]
    uvs = (places[vertex] + np.stack([sheet * width, 0 * sheet], axis=1)) / (len(numbers) * width, height)
    return MeshTexture(
        np.ascontiguousarray(np.hstack(list(image))),
        vertex,
        unwrapped.reshape(-1, 3).astype(np.int32),
        uvs.astype(np.float32),
    )


def _on_sheet(maps: LayerMaps, points: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(V, 2) column and row on a sheet of `shape` (views, height, width); the middle of a texel is at ½."""
    row0, column0 = maps.window[:2]
    x = (points[:, 0].astype(np.float64) - maps.centre[0]) / maps.pitch + maps.grid_size / 2 - column0
    y = (maps.centre[1] - points[:, 1].astype(np.float64)) / maps.pitch + maps.grid_size / 2 - row0
    limits = np.array([shape[2], shape[1]]) - 1e-3
    return np.clip(np.stack([x, y], axis=1) + _MARGIN, 0, limits)

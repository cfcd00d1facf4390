"""Preview picture of a mesh: front and back view in one image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import vertex_normals

_GREY = 190.0
_LIGHT = np.array([0.3, 0.5, 0.81])


def two_sided_picture(
    vertices: ArrayLike, faces: NDArray, colors: NDArray | None = None, height: int = 720, shade: float = 0.6
) -> NDArray[np.uint8]:
    """Front view and back view (mirrored, as one sees it), orthographic along z, on white.

    Arguments:
        vertices: (V, 3) metres, +y up, facing +z. faces: (F, 3). colors: (V, 3) u8, or None for grey.
        height: pixels of the mesh's own height and a margin. shade: 0 plain colours … 1 fully lit.

    Returns:
        (height, 2 W, 3) u8.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    if not len(faces):
        return np.full((height, height, 3), 255, np.uint8)
    scene = RayScene(vertices, faces)
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    pitch = 1.05 * max(high[1] - low[1], (high[0] - low[0]) / 2, 1e-6) / height
    width = max(int(np.ceil(1.05 * (high[0] - low[0]) / pitch)), 1)
    middle = (low + high) / 2
    x = middle[0] + (np.arange(width) + 0.5 - width / 2) * pitch
    y = middle[1] - (np.arange(height) + 0.5 - height / 2) * pitch
    painted = np.full((len(vertices), 3), _GREY) if colors is None else np.asarray(colors, dtype=np.float64)
    normals = vertex_normals(vertices, faces)
    views = []
    for back in (False, True):
        hits = scene.orthographic(x, y, back=back)
        facing = hits.interpolate(faces, normals) * (np.array([-1, 1, -1]) if back else 1)
        light = (1 - shade) + shade * np.abs(facing @ _LIGHT)
        picture = np.where(hits.hit[..., None], hits.interpolate(faces, painted) * light[..., None], 255.0)
        views.append(picture[:, ::-1] if back else picture)
    return np.clip(np.rint(np.concatenate(views, axis=1)), 0, 255).astype(np.uint8)

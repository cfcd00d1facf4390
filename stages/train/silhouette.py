"""The silhouette of a mesh in a camera: all triangles are drawn, none hides another."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture import Camera


def rasterize_silhouette(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], camera: Camera
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels whose centre a triangle of the mesh covers.

    Arguments:
        vertices: (V, 3) m, world. faces: (F, 3). Triangles that reach behind the camera are left out.
    """
    pixels, _ = camera.project(vertices)
    covered = np.zeros((camera.height, camera.width), dtype=np.bool_)
    _draw(pixels, np.ascontiguousarray(faces, dtype=np.int64), covered)
    return covered


@numba.njit(cache=True, nogil=True)
def _draw(pixels: NDArray[np.float64], faces: NDArray[np.int64], covered: NDArray[np.bool_]) -> None:
    """Set the pixels of every triangle; `pixels` (V, 2) x, y, NaN behind the camera."""
    height, width = covered.shape
    for face in range(faces.shape[0]):
        ax, ay = pixels[faces[face, 0]]
        bx, by = pixels[faces[face, 1]]
        cx, cy = pixels[faces[face, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:  # also NaN
            continue
        left, right = max(0.0, min(ax, bx, cx) - 0.5), min(width - 1.0, max(ax, bx, cx) - 0.5)
        top, bottom = max(0.0, min(ay, by, cy) - 0.5), min(height - 1.0, max(ay, by, cy) - 0.5)
        if left > right or top > bottom:
            continue
        for row in range(int(np.ceil(top)), int(bottom) + 1):
            y = row + 0.5
            for column in range(int(np.ceil(left)), int(right) + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if u >= 0 and v >= 0 and u + v <= 1:
                    covered[row, column] = True

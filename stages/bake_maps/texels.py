"""From ray hits to texels: which there are, and what they take over from the surface by interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.bake_maps.grid import Grid
from stages.bake_maps.peel import MOST_SHEETS, Exposure, hidden_hits
from stages.shared.errors import BadData
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals, vertex_normals


@dataclass(frozen=True)
class Texels:
    """Surface points that a layer's maps show, in the order view, row, column.

    Attributes:
        texels: (N, 3) int32 view, row, column on the global grid; even views face the front, odd ones the
            back; 0 and 1 are met first, higher ones are peeled off below.
        window: row0, column0, height, width.
        face: (N,) number of the face that was hit. barycentric: (N, 3) weights of its corners.
    """

    texels: np.ndarray
    window: tuple[int, int, int, int]
    face: np.ndarray
    barycentric: np.ndarray

    @property
    def views(self) -> int:
        """Number of views, even."""
        return 2 * (int(self.texels[-1, 0]) // 2 + 1) if len(self.texels) else 2

    def outward(self, vertices: np.ndarray, faces: np.ndarray, seen_in: np.ndarray) -> np.ndarray:
        """Unit normals (N, 3) of vertices (V, 3), interpolated, on the side that the view sees.

        A face seen from behind (the inside of a skirt, a flipped face) shows its other side, so its normal is
        turned. `seen_in` are the canonical vertices the maps were cast on; `vertices` may be those posed.
        """
        normals = self.interpolate(faces, vertex_normals(vertices, faces))
        sign = np.where(self.texels[:, 0] % 2 == 0, 1.0, -1.0)
        behind = face_normals(seen_in, faces)[0][self.face, 2] * sign < 0
        normals[behind] *= -1.0
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)

    def interpolate(self, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Per-vertex values (V, ...) at the texels, (N, ...) float64."""
        flat = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
        corners = faces[self.face]
        values_at_texels = sum(self.barycentric[:, k, None] * flat[corners[:, k]] for k in range(3))
        return np.asarray(values_at_texels).reshape(len(self.face), *np.shape(values)[1:])


def cast_texels(vertices: np.ndarray, faces: np.ndarray, grid: Grid, layer: str, sheets: int = 0) -> Texels:
    """Hits of the parallel rays through all texels of the layer's window, from front and back.

    What is met first becomes a texel, and on `sheets` further sheets a side what lies below it and is not
    enclosed (as the scalp under the hair or the foot in the shoe is). A hidden surface is peeled off on the
    side that it faces, so no surface point gets two texels there.

    Raises:
        BadData: the layer reaches beyond the grid, or no ray meets it.
    """
    row0, column0, height, width = window = grid.window(vertices[np.unique(faces)], layer)
    rows, columns = row0 + np.arange(height), column0 + np.arange(width)
    x = grid.positions(np.zeros(width), columns)[:, 0]
    y = grid.positions(rows, np.zeros(height))[:, 1]
    scene = RayScene(vertices, faces)
    parts = []
    for view in range(2):
        hits = scene.orthographic(x, y, back=bool(view))
        row, column = np.nonzero(hits.hit)
        texels = np.stack([np.full(len(row), view), rows[row], columns[column]], axis=1)
        parts.append((texels, hits.face[hits.hit], hits.barycentric[hits.hit]))
    if sheets:
        parts += _peeled(scene, x, y, rows, columns, min(sheets, MOST_SHEETS))
    texels, face, barycentric = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not len(texels):
        raise BadData(
            f"No ray meets the layer {layer}: its mesh has no surface that the front or back view sees.",
            f"layer {layer}",
            "Look at preview.png of segment-layers; label the template again.",
        )
    barycentric = np.clip(barycentric.astype(np.float64), 0.0, 1.0)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    order = np.lexsort(texels.T[::-1])
    return Texels(texels[order].astype(np.int32), window, face[order], barycentric[order])


def _peeled(
    scene: RayScene, x: np.ndarray, y: np.ndarray, rows: np.ndarray, columns: np.ndarray, sheets: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Texels, faces and barycentric weights of the peeled sheets."""
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    hidden = hidden_hits(scene, places, Exposure(scene))
    chosen = hidden.sheet <= sheets
    row, column = np.divmod(hidden.ray[chosen], len(x))
    view = 2 * hidden.sheet[chosen] + hidden.side[chosen]
    texels = np.stack([view, rows[row], columns[column]], axis=1)
    return [(texels, hidden.face[chosen], hidden.barycentric[chosen])]

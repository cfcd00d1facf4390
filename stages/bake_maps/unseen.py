"""Share of the surface of a layer that its maps do not show."""

from __future__ import annotations

import numpy as np

from stages.bake_maps.peel import MOST_SHEETS, hidden_hits
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals

_LIFT = 2e-4  # metres: rays start this far off the surface
_SAME = 1e-3  # metres along z: a hit this near to a point is that point
_DIRECTIONS = 24


class Exposure:
    """Whether surface points can be seen from anywhere outside: a ray from either side escapes in one of some
    directions. Leaves out what is enclosed, such as the scalp under the hair."""

    def __init__(self, scene: RayScene) -> None:
        self._scene = scene

    def __call__(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) bool for points (N, 3) on the surface and unit normals (N, 3) of their faces."""
        exposed = np.zeros(len(points), dtype=bool)
        for direction in sphere_directions(_DIRECTIONS):
            open_rows = np.flatnonzero(~exposed)
            if not len(open_rows):
                break
            exposed[open_rows] = _escapes(self._scene, points[open_rows], normals[open_rows], direction)
        return exposed


def unseen_shares(vertices: np.ndarray, faces: np.ndarray, samples: int = 20_000) -> np.ndarray:
    """(MOST_SHEETS + 1,) shares (0 to 1) of the exposed area that no view sees, with 0, 1, … peeled sheets.

    Points are spread over the faces by area (the same ones every time). A point is seen without peeling when
    a ray along +z or −z escapes from it, and with k sheets also when it is among the first k hidden
    surfaces that face its side. Points that are not exposed (`Exposure`) do not count.
    """
    points, normals = surface_points(vertices, faces, samples)
    shares = np.zeros(MOST_SHEETS + 1)
    if not len(points):
        return shares
    scene = RayScene(vertices, faces)
    seen = np.zeros(len(points), dtype=bool)
    for direction in np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]):
        seen |= _escapes(scene, points, normals, direction)
    rest = np.flatnonzero(~seen)
    rest = rest[Exposure(scene)(points[rest], normals[rest])]
    sheet = _sheets_of(scene, points[rest])
    total = len(rest) + int(np.count_nonzero(seen))
    for sheets in range(MOST_SHEETS + 1):
        shares[sheets] = np.count_nonzero(sheet > sheets) / max(total, 1)
    return shares


def _sheets_of(scene: RayScene, points: np.ndarray) -> np.ndarray:
    """(N,) on which peeled sheet each hidden point (N, 3) lies; beyond all of them where on none."""
    hidden = hidden_hits(scene, points[:, :2], Exposure(scene))
    sheet = np.full(len(points), MOST_SHEETS + 1)
    here = np.abs(hidden.depth - points[hidden.ray, 2]) < _SAME
    np.minimum.at(sheet, hidden.ray[here], hidden.sheet[here])
    return sheet


def surface_points(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` points (N, 3), evenly by area, and the unit normals of their faces; no randomness."""
    normals, areas = face_normals(vertices, faces)
    if not areas.sum() > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    reached = np.cumsum(areas) / areas.sum()
    face = np.minimum(np.searchsorted(reached, (np.arange(count) + 0.5) / count), len(faces) - 1)
    # A low-discrepancy pair per point (plastic number), folded into the triangle.
    first, second = np.modf(np.outer(np.arange(count), [0.7548776662, 0.5698402910]) + 0.5)[0].T
    folded = first + second > 1
    first, second = np.where(folded, 1 - first, first), np.where(folded, 1 - second, second)
    weights = np.stack([1 - first - second, first, second], axis=1)
    return np.einsum("nk,nkc->nc", weights, np.asarray(vertices, float)[faces[face]]), normals[face]


def sphere_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly over the sphere (golden spiral)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)


def _escapes(scene: RayScene, points: np.ndarray, normals: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(N,) bool: a ray towards `direction` from just off the surface, on that side of it, meets nothing."""
    side = np.where(normals @ direction >= 0, 1.0, -1.0)[:, None]
    return ~scene.first_hits(points + _LIFT * side * normals, direction).hit

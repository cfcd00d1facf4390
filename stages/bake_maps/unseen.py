"""How much of a layer's surface the two views miss."""

from __future__ import annotations

import numpy as np

from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals

_LIFT = 2e-4  # metres: rays start this far off the surface
_DIRECTIONS = 24


def unseen_share(vertices: np.ndarray, faces: np.ndarray, samples: int = 20_000) -> float:
    """Share of the outwardly visible area that neither the front nor the back view sees (0 to 1).

    Points are spread over the faces by area (the same ones every time). A point counts as outwardly visible
    when a ray from either side of it escapes in at least one of some directions, which leaves out what is
    enclosed, such as the scalp under the hair; it is seen when a ray along +z or −z escapes.
    """
    points, normals = surface_points(vertices, faces, samples)
    if not len(points):
        return 0.0
    scene = RayScene(vertices, faces)
    seen = np.zeros(len(points), dtype=bool)
    for direction in np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]):
        seen |= _escapes(scene, points, normals, direction)
    open_rows = np.flatnonzero(~seen)
    exposed = np.zeros(len(open_rows), dtype=bool)
    for direction in sphere_directions(_DIRECTIONS):
        exposed |= _escapes(scene, points[open_rows], normals[open_rows], direction)
    unseen = int(np.count_nonzero(exposed))
    return unseen / (unseen + int(np.count_nonzero(seen)))


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

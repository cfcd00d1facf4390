"""Depth peeling: surfaces behind the first hit of parallel rays, assigned to further sheets of the maps.

Front and back view hold the first hits. Surfaces in between (the lower side of a fold, the inside of a
thigh) go to further sheets. A hidden surface that faces the front goes to a sheet of the front, one that
faces the back to a sheet of the back, the nearest to its view first. `unseen_shares` measures which share of
a surface is on no sheet.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import face_normals

MOST_SHEETS = 15  # a side, besides the first hit
_MOST_HITS = 64  # surfaces along one ray; meshes with more are not cloth
_STEP = 1e-4  # metres behind a hit where the ray goes on
_SAME = 2e-4  # metres; hits this near to the first of either view are that surface

Exposed = Callable[[np.ndarray, np.ndarray], np.ndarray]  # points (N, 3), normals (N, 3) -> (N,) bool


@dataclass(frozen=True)
class HiddenHits:
    """H surface points that neither view meets first.

    Attributes:
        ray: (H,) number of the ray. side: (H,) 0 faces the front, 1 the back. sheet: (H,) 1, 2, …: which of
            that side's hidden points along the ray, nearest to the viewer first.
        depth: (H,) z, metres. face: (H,). barycentric: (H, 3).
    """

    ray: np.ndarray
    side: np.ndarray
    sheet: np.ndarray
    depth: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray


def hidden_hits(scene: RayScene, places: np.ndarray, exposed: Exposed) -> HiddenHits:
    """All hidden and exposed hits of rays along z through places (R, 2), ordered by ray, side, sheet."""
    ray, depth, face, barycentric = _all_hits(scene, places)
    first, last = np.full(len(places), -np.inf), np.full(len(places), np.inf)
    np.maximum.at(first, ray, depth)
    np.minimum.at(last, ray, depth)
    keep = (depth < first[ray] - _SAME) & (depth > last[ray] + _SAME)
    ray, depth, face, barycentric = ray[keep], depth[keep], face[keep], barycentric[keep]
    normals = face_normals(scene.vertices, scene.faces)[0][face]
    free = exposed(np.concatenate([places[ray], depth[:, None]], axis=1), normals)
    ray, depth, face, barycentric = ray[free], depth[free], face[free], barycentric[free]
    side = (normals[free, 2] < 0).astype(np.int64)
    order = np.lexsort((np.where(side == 0, -depth, depth), side, ray))
    ray, side = ray[order], side[order]
    new = np.ones(len(ray), dtype=bool)
    new[1:] = (ray[1:] != ray[:-1]) | (side[1:] != side[:-1])
    start = np.maximum.accumulate(np.where(new, np.arange(len(ray)), 0))
    sheet = np.arange(len(ray)) - start + 1
    return HiddenHits(ray, side, sheet, depth[order], face[order], barycentric[order])


def _all_hits(scene: RayScene, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Every surface that rays from the front meet: ray, depth z, face, barycentric weights."""
    top = float(scene.vertices[:, 2].max()) + 1.0
    active = np.arange(len(places))
    travelled = np.zeros(len(places))
    parts = []
    for _ in range(_MOST_HITS):
        origins = np.concatenate([places[active], (top - travelled[active])[:, None]], axis=1)
        hits = scene.first_hits(origins, np.array([0.0, 0.0, -1.0]))
        active = active[hits.hit]
        if not len(active):
            break
        depth = origins[hits.hit, 2] - hits.distance[hits.hit]
        parts.append((active, depth, hits.face[hits.hit], hits.barycentric[hits.hit]))
        travelled[active] = top - depth + _STEP
    if not parts:
        return np.zeros(0, int), np.zeros(0), np.zeros(0, int), np.zeros((0, 3))
    ray, depth, face, barycentric = (np.concatenate(column) for column in zip(*parts, strict=True))
    return ray, depth, face, barycentric


_LIFT = 2e-4  # metres: rays start this far off the surface
_SAME_POINT = 1e-3  # metres along z: a hit this near to a point is that point
_DIRECTIONS = 24


class Exposure:
    """Whether surface points can be seen from outside: in one of 24 directions a ray from them meets nothing.

    Points that are enclosed, such as the scalp under the hair, are not exposed.
    """

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
    here = np.abs(hidden.depth - points[hidden.ray, 2]) < _SAME_POINT
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

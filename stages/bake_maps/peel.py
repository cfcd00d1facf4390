"""Depth peeling: surfaces behind the first hit of parallel rays, assigned to further sheets of the maps.

Front and back view hold the first hits. Surfaces in between (the lower side of a fold, the inside of a
thigh) go to further sheets. A hidden surface that faces the front goes to a sheet of the front, one that
faces the back to a sheet of the back, the nearest to its view first.
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
    found = []
    for _ in range(_MOST_HITS):
        origins = np.concatenate([places[active], (top - travelled[active])[:, None]], axis=1)
        hits = scene.first_hits(origins, np.array([0.0, 0.0, -1.0]))
        active = active[hits.hit]
        if not len(active):
            break
        depth = origins[hits.hit, 2] - hits.distance[hits.hit]
        found.append((active, depth, hits.face[hits.hit], hits.barycentric[hits.hit]))
        travelled[active] = top - depth + _STEP
    if not found:
        return np.zeros(0, int), np.zeros(0), np.zeros(0, int), np.zeros((0, 3))
    ray, depth, face, barycentric = (np.concatenate(column) for column in zip(*found, strict=True))
    return ray, depth, face, barycentric

"""Keeping cloth outside a surface: the body, or the garment below it.

Each cloth vertex remembers the surface vertex nearest to it (found once a frame, followed along the mesh
in between) and is pushed off the closest point of that vertex's triangles, with friction.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.synth.offset_surface import border_vertices

Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

REACH = 0.07  # metres: cloth farther away at the start of a frame cannot arrive within it
DEEPEST_UNDER_CLOTH = 0.025  # deeper than this under another garment is another place, not a contact


@dataclass(eq=False)
class Collider:
    """A moving surface.

    Attributes:
        faces: (F, 3) triangles.
        usable: (V,) vertices that cloth may touch.
        closed: a body (always pushes out) or a garment (has borders and an inside that is free).
        friction: Coulomb coefficient.
    """

    faces: Indices
    usable: NDArray[np.bool_]
    closed: bool
    friction: float
    first: Indices = field(init=False)
    incident: Indices = field(init=False)
    border: NDArray[np.bool_] = field(init=False)
    _candidates: Indices = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.usable)
        corner = self.faces.ravel()
        order = np.argsort(corner, kind="stable")
        self.incident = np.ascontiguousarray(order // 3)
        self.first = np.concatenate([[0], np.cumsum(np.bincount(corner, minlength=count))])
        self.border = border_vertices(count, self.faces) if not self.closed else np.zeros(count, dtype=bool)
        self._candidates = np.flatnonzero(self.usable)

    def tree(self, surface: Doubles) -> cKDTree:
        """Search tree over the usable vertices of the surface (V, 3) where it is now."""
        return cKDTree(surface[self._candidates])

    def nearest(self, tree: cKDTree, points: Doubles) -> Indices:
        """(N,) nearest usable surface vertex of each point, −1 beyond reach."""
        distance, index = tree.query(points, distance_upper_bound=REACH)
        found = np.isfinite(distance)
        return np.where(found, self._candidates[np.where(found, index, 0)], -1)


@njit(cache=True, nogil=True)
def push_out(  # type: ignore[no-untyped-def]
    positions,
    previous,
    nearest,
    surface,
    surface_before,
    normals,
    faces,
    first,
    incident,
    border,
    distance,
    friction,
    closed,
):
    """Move cloth vertices to at least `distance` metres outside the surface; slow their sliding.

    Arguments:
        positions, previous: (N, 3) cloth now and at the start of the step; positions change.
        nearest: (N,) surface vertices to start from, −1 for none; followed and updated.
        surface, surface_before: (V, 3) the surface at the end and the start of the step.
        normals: (V, 3) outward unit normals at the end of the step.
        faces, first, incident: triangles, and the triangles around each vertex (CSR).
        border: (V,) open border of a garment.
    """
    point, point_before, normal = np.zeros(3), np.zeros(3), np.zeros(3)
    weights, best = np.zeros(3), np.zeros(3)
    for i in range(len(positions)):
        start = nearest[i]
        if start < 0:
            continue
        closest, face = 1e30, -1
        for slot in range(first[start], first[start + 1]):
            f = incident[slot]
            squared = _closest(positions[i], surface, faces[f], weights)
            if squared < closest:
                closest, face = squared, f
                best[0], best[1], best[2] = weights[0], weights[1], weights[2]
        if face < 0:
            continue
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        nearest[i] = a if best[0] >= best[1] and best[0] >= best[2] else (b if best[1] >= best[2] else c)
        size, depth = 1e-20, 0.0
        for k in range(3):
            point[k] = best[0] * surface[a, k] + best[1] * surface[b, k] + best[2] * surface[c, k]
            point_before[k] = (
                best[0] * surface_before[a, k]
                + best[1] * surface_before[b, k]
                + best[2] * surface_before[c, k]
            )
            normal[k] = best[0] * normals[a, k] + best[1] * normals[b, k] + best[2] * normals[c, k]
            size += normal[k] ** 2
        size = np.sqrt(size)
        for k in range(3):
            normal[k] /= size
            depth += (positions[i, k] - point[k]) * normal[k]
        if depth >= distance:
            continue
        if not closed:
            aside = closest - depth * depth
            if depth < -DEEPEST_UNDER_CLOTH or aside > 1.6e-5 or (border[nearest[i]] and aside > 1e-6):
                continue
        push = min(distance - depth, 0.02)
        for k in range(3):
            positions[i, k] += push * normal[k]
        _rub(positions[i], previous[i], point, point_before, normal, friction * push)


@njit(cache=True, nogil=True)
def _rub(position, previous, point, point_before, normal, limit):  # type: ignore[no-untyped-def]
    """Take back up to `limit` metres of the sliding relative to the surface."""
    along = 0.0
    for k in range(3):
        along += (position[k] - previous[k] - point[k] + point_before[k]) * normal[k]
    slide = 0.0
    for k in range(3):
        part = position[k] - previous[k] - point[k] + point_before[k] - along * normal[k]
        slide += part * part
    slide = np.sqrt(slide)
    if slide < 1e-12:
        return
    share = min(1.0, limit / slide)
    for k in range(3):
        part = position[k] - previous[k] - point[k] + point_before[k] - along * normal[k]
        position[k] -= share * part


@njit(cache=True, nogil=True)
def _closest(p, surface, face, weights):  # type: ignore[no-untyped-def]
    """Squared distance from p to a triangle; weights of the closest point (Ericson 2005, 5.1.5)."""
    ia, ib, ic = face[0], face[1], face[2]
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for k in range(3):
        ab, ac = surface[ib, k] - surface[ia, k], surface[ic, k] - surface[ia, k]
        pa, pb, pc = p[k] - surface[ia, k], p[k] - surface[ib, k], p[k] - surface[ic, k]
        d1 += ab * pa
        d2 += ac * pa
        d3 += ab * pb
        d4 += ac * pb
        d5 += ab * pc
        d6 += ac * pc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3 + 1e-30), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6 + 1e-30)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6) + 1e-30)
        v = 1.0 - w
    else:
        scale = 1.0 / (va + vb + vc + 1e-30)
        v, w = vb * scale, vc * scale
    weights[0], weights[1], weights[2] = 1.0 - v - w, v, w
    squared = 0.0
    for k in range(3):
        part = p[k] - weights[0] * surface[ia, k] - v * surface[ib, k] - w * surface[ic, k]
        squared += part * part
    return squared

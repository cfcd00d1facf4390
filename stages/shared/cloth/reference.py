"""The frame of one garment in plain NumPy: slow, one constraint after the other, to compare the kernels with.

The same steps as in `kernels` and `contact`, without their shortcuts where those do not change the result.
Contact looks at every face of a surface, so it agrees with the walk over neighbours on surfaces that are
convex or far from themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.shared.cloth.constraints import Constraints, area_normals
from stages.shared.cloth.contact import ACROSS, ACROSS_BODY, DEEPEST_BENEATH_CLOTH, LARGEST_PUSH, SAME_WAY
from stages.shared.cloth.material import STRAIN_LIMIT, Material
from stages.shared.cloth.surface import Moving

Doubles = NDArray[np.float64]


def reference_frame(
    positions: Doubles,
    velocities: Doubles,
    cloth: Constraints,
    surfaces: list[tuple[Moving, Doubles]],
    pins: dict[int, tuple[Doubles, Doubles]],
    gravity: Doubles,
    seconds: float,
    substeps: int,
    material: Material,
    pairs: list[tuple[int, int]],
) -> tuple[Doubles, Doubles]:
    """Positions and velocities (V, 3) after one frame; arguments as in `advance_frame`.

    Arguments:
        surfaces: each with its margins (V,). pins: vertex to its place at the start and the end of the frame.
    """
    x, v = positions.copy(), velocities.copy()
    step = seconds / substeps
    free = cloth.inverse_mass > 0
    facing = area_normals(x, cloth.faces)
    for number in range(substeps):
        end = (number + 1) / substeps
        before = x.copy()
        x[free] += step * (v[free] * np.exp(-material.drag * step) + step * gravity)
        for vertex, (start, stop) in pins.items():
            x[vertex] = start + end * (stop - start)
        for edge, rest in zip(cloth.edges, cloth.edge_rest, strict=True):
            _edge(x, cloth.inverse_mass, edge, rest, 1.0 / (material.edge_stiffness * step**2))
        if material.bending > 0:
            normals = area_normals(x, cloth.faces)
            for number_of_bend in range(len(cloth.bend_vertex)):
                _bend(x, before, normals, cloth, number_of_bend, material, step)
        for pair in pairs if material.repulsion > 0 else []:
            _repel(x, before, cloth.inverse_mass, pair, material.repulsion)
        for surface, margins in surfaces:
            for i in np.flatnonzero(free):
                _touch(x, before, facing[i], int(i), surface, float(margins[i]), end, 1.0 / substeps)
        v = (x - before) / step
    return x, v


def _edge(x: Doubles, w: Doubles, edge: NDArray, rest: float, softness: float) -> None:
    a, b = edge
    total = w[a] + w[b]
    apart = x[a] - x[b]
    length = np.linalg.norm(apart)
    if total == 0 or length < 1e-9:
        return
    change = max((length - rest) * total / (total + softness), length - STRAIN_LIMIT * rest)
    direction = apart / length
    x[a] -= w[a] / total * change * direction
    x[b] += w[b] / total * change * direction


def _bend(
    x: Doubles, before: Doubles, normals: Doubles, cloth: Constraints, b: int, material: Material, step: float
) -> None:
    i = cloth.bend_vertex[b]
    ring = slice(cloth.bend_start[b], cloth.bend_start[b + 1])
    neighbours, weights = cloth.bend_ring[ring], cloth.bend_weight[ring]
    normal, w = normals[i], cloth.inverse_mass
    value = (weights[:, None] * (x[neighbours] - x[i])).sum(axis=0) @ normal - cloth.bend_rest[b]
    earlier = (weights[:, None] * (before[neighbours] - before[i])).sum(axis=0) @ normal
    motion = value + cloth.bend_rest[b] - earlier
    gradient = (weights**2 * w[neighbours]).sum() + weights.sum() ** 2 * w[i]
    damped = material.bending_damping / step
    softness = cloth.bend_area[b] / (material.bending * step**2)
    multiplier = -(value + damped * motion) / ((1 + damped) * gradient + softness)
    x[neighbours] += (multiplier * weights * w[neighbours])[:, None] * normal
    x[i] -= multiplier * weights.sum() * w[i] * normal


def _repel(x: Doubles, before: Doubles, w: Doubles, pair: tuple[int, int], least: float) -> None:
    a, b = pair
    apart = x[a] - x[b]
    length = np.linalg.norm(apart)
    if not 1e-9 <= length < least or w[a] + w[b] == 0:
        return
    move = (least - length) / (w[a] + w[b]) * apart / length
    for places in (x, before):
        places[a] += w[a] * move
        places[b] -= w[b] * move


def _touch(
    x: Doubles,
    before: Doubles,
    facing: Doubles,
    i: int,
    moving: Moving,
    margin: float,
    end: float,
    part: float,
) -> None:
    surface = moving.surface
    now = moving.before + end * (moving.after - moving.before)
    corners = now[surface.faces]
    closest, weights = nearest_on_triangles(x[i], corners)
    face = int(np.argmin(((closest - x[i]) ** 2).sum(axis=1)))
    used, w = surface.faces[face], weights[face]
    normals = moving.normals_before + end * (moving.normals_after - moving.normals_before)
    normal = w @ normals[used]
    normal /= np.linalg.norm(normal)
    depth = (x[i] - closest[face]) @ normal
    distance = np.linalg.norm(x[i] - closest[face])
    across = ACROSS_BODY if surface.closed else ACROSS
    if depth >= margin or (distance > margin and abs(depth) < across * distance):
        return
    if not surface.closed and (depth < -DEEPEST_BENEATH_CLOTH or facing @ normal < SAME_WAY):
        return
    push = min(margin - depth, LARGEST_PUSH)
    x[i] += push * normal
    motion = part * (w @ (moving.after - moving.before)[used])
    relative = x[i] - before[i] - motion
    along = relative @ normal
    sliding = relative - along * normal
    slide = np.linalg.norm(sliding)
    if slide > 1e-12:
        x[i] -= min(1.0, surface.friction * push / slide) * sliding
    before[i] += max(along, 0.0) * normal


def nearest_on_triangles(point: Doubles, corners: Doubles) -> tuple[Doubles, Doubles]:
    """Nearest points (F, 3) on triangles (F, 3, 3), and their barycentric weights (F, 3).

    The nearest point is the foot of the perpendicular where that lies inside, else one on a side.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    squared = np.maximum((normal**2).sum(axis=1), 1e-300)
    u = (np.cross(c - b, point - b) * normal).sum(axis=1) / squared
    v = (np.cross(a - c, point - c) * normal).sum(axis=1) / squared
    inside = np.stack([u, v, 1 - u - v], axis=1)
    candidates = [np.where(inside.min(axis=1, keepdims=True) >= 0, inside, np.nan)]
    for first in range(3):
        second = (first + 1) % 3
        side = corners[:, second] - corners[:, first]
        share = ((point - corners[:, first]) * side).sum(axis=1) / np.maximum((side**2).sum(axis=1), 1e-300)
        weights = np.zeros((len(corners), 3))
        weights[:, second] = np.clip(share, 0, 1)
        weights[:, first] = 1 - weights[:, second]
        candidates.append(weights)
    stacked = np.stack(candidates)
    points = np.einsum("kfi,fic->kfc", stacked, corners)
    far = ((points - point) ** 2).sum(axis=2)
    best = np.where(np.isnan(far), np.inf, far).argmin(axis=0)
    rows = np.arange(len(corners))
    return points[best, rows], stacked[best, rows]

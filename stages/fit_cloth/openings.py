"""Rims of a garment: holes that a scan left are closed, openings for limbs are kept.

A rim is an opening when it is long and a bone of the body passes through it: sleeves, the neck, the waist,
the hem. The other rims are places that no camera saw, such as armpits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stages.shared.body import PARENTS
from stages.shared.meshes import RayScene, boundary_edges

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]

SHORTEST_OPENING = 0.2  # metres around a sleeve, at the least
_BODY_JOINTS = 22  # without face and fingers
_BEYOND = 1.5  # bones are this much longer than from joint to joint, so that they leave neck and sleeves


def rims(faces: Indices, vertex_count: int) -> list[Indices]:
    """Boundary edges (K, 2) of every rim, in the direction of their faces."""
    rim_edges = boundary_edges(faces)
    graph = sparse.coo_array(
        (np.ones(len(rim_edges)), (rim_edges[:, 0], rim_edges[:, 1])), shape=(vertex_count, vertex_count)
    )
    part = sparse.csgraph.connected_components(graph, directed=False)[1][rim_edges[:, 0]]
    return [rim_edges[part == number] for number in np.unique(part)]


def close_holes(vertices: Doubles, faces: Indices, joints: Doubles) -> tuple[Doubles, Indices]:
    """The garment with every rim closed through which no bone passes.

    Arguments:
        vertices: (V, 3) m, world. joints: (55, 3) m of the body in the same pose.
    """
    points, triangles = [vertices], [faces]
    count = len(vertices)
    for rim in rims(faces, len(vertices)):
        cap = _cap(vertices, rim)
        length = np.linalg.norm(vertices[rim[:, 0]] - vertices[rim[:, 1]], axis=1).sum()
        if length > SHORTEST_OPENING and _bones_pass(cap, joints):
            continue
        points.append(cap[2].mean(axis=0, keepdims=True))
        middle = np.full(len(rim), count)
        triangles.append(np.stack([rim[:, 1], rim[:, 0], middle], axis=1).astype(np.int32))
        count += 1
    return np.concatenate(points), np.concatenate(triangles)


def highest_rim(vertices: Doubles, faces: Indices, least_length: float = 0.2) -> Indices:
    """Vertices of the rim that lies highest on average, among those at least so many metres long."""
    best, height = np.zeros(0, dtype=np.int32), -np.inf
    for rim in rims(faces, len(vertices)):
        length = np.linalg.norm(vertices[rim[:, 0]] - vertices[rim[:, 1]], axis=1).sum()
        mean = float(vertices[rim[:, 0], 1].mean())
        if length >= least_length and mean > height:
            best, height = np.unique(rim).astype(np.int32), mean
    return best


def _cap(vertices: Doubles, rim: Indices) -> tuple[Doubles, Indices, Doubles]:
    """A fan over a rim: its vertices, its faces, and the rim's own points."""
    own = np.unique(rim)
    around = vertices[own]
    points = np.concatenate([around, around.mean(axis=0, keepdims=True)])
    ends = np.searchsorted(own, rim)
    fan = np.stack([ends[:, 1], ends[:, 0], np.full(len(rim), len(own))], axis=1)
    return points, fan.astype(np.int32), around


def _bones_pass(cap: tuple[Doubles, Indices, Doubles], joints: Doubles) -> bool:
    children = np.arange(1, _BODY_JOINTS)
    start = joints[np.asarray(PARENTS)[children]]
    hits = RayScene(cap[0], cap[1]).first_hits(start, joints[children] - start)
    return bool((hits.distance <= _BEYOND).any())

"""How many people a scan shows: parts that touch or enclose each other are one, people stand apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import components, face_normals, keep_faces

# Shares of the mesh: the area of a part that is looked at, the gap below which two parts belong together, and
# the height, the area and the distance (between middles) of two people.
_PART_AREA, _GAP = 0.01, 0.03
_PERSON_TALL, _PERSON_AREA, _APART = 0.5, 0.2, 0.15
_MOST_PARTS = 40
_SAMPLES = 3000
_STANDING = 1.5  # a standing person is so many times taller than wide


def refuse_two_people(mesh: Mesh, where: str) -> None:
    """Raise BadData when a mesh shows two people side by side.

    Layered scans and modelling tools give jacket, trousers, shirt and skin as separate surfaces. Such parts
    lie within a few centimetres of each other, one above or around the other. Two people leave a gap between
    them, or stand side by side.
    """
    whole = float(np.ptp(mesh.vertices, axis=0).max())
    parts, areas = _large_parts(mesh)
    group = _belonging_together(parts, whole)
    people = []
    for number in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == number)
        vertices = np.concatenate([parts[member].vertices for member in members])
        tall = np.ptp(vertices, axis=0).max() > _PERSON_TALL * whole
        if tall and areas[members].sum() > _PERSON_AREA:
            people.append(_middle(vertices))
    for place, one in enumerate(people):
        for other in people[place + 1 :]:
            apart = np.linalg.norm(one - other)
            if apart > _APART * whole:
                raise two_people(where, f"two parts stand {apart:.3g} units apart")


def two_people(where: str, reason: str) -> BadData:
    """The error for a mesh with more than one person in it."""
    return BadData(
        f"There is more than one person in the mesh, or a person and something large: {reason}.",
        where,
        "Cut the mesh so that one person is left.",
    )


def _large_parts(mesh: Mesh) -> tuple[list[Mesh], NDArray[np.float64]]:
    """The connected parts of more than `_PART_AREA` of the surface, and their shares of it (P,)."""
    part = components(mesh.faces, len(mesh.vertices))
    of_face = part[mesh.faces[:, 0]]
    areas = np.bincount(of_face, face_normals(mesh.vertices, mesh.faces)[1])
    shares = areas / areas.sum()
    large = np.flatnonzero(shares > _PART_AREA)
    large = large[np.argsort(-shares[large], kind="stable")][:_MOST_PARTS]
    parts = []
    for number in large:
        faces, rows = keep_faces(mesh.faces, of_face == number, len(mesh.vertices))
        parts.append(Mesh(mesh.vertices[rows], faces))
    return parts, shares[large]


def _belonging_together(parts: list[Mesh], whole: float) -> NDArray[np.int32]:
    """(P,) group number of every part: parts with a small gap between them that are not abreast."""
    first, second = [], []
    for one in range(len(parts)):
        for other in range(one + 1, len(parts)):
            if _abreast(parts[one].vertices, parts[other].vertices, whole):
                continue
            if _gap(parts[one], parts[other], whole) < _GAP * whole:
                first.append(one)
                second.append(other)
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(len(parts), len(parts)))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


def _abreast(one: NDArray[np.floating], other: NDArray[np.floating], whole: float) -> bool:
    """Whether two parts are both tall and slim, as tall as the mesh, and side by side."""
    apart = np.abs(_middle(one) - _middle(other))
    across = int(apart.argmax())
    up = int(np.argsort(np.where(np.arange(3) == across, -1, np.ptp(one, axis=0)))[-1])
    sizes = np.stack([np.ptp(one, axis=0), np.ptp(other, axis=0)])
    standing = (sizes[:, up] > _STANDING * sizes[:, across]) & (sizes[:, up] > _PERSON_TALL * whole)
    return bool(standing.all() and apart[across] > _APART * whole)


def _gap(one: Mesh, other: Mesh, whole: float) -> float:
    """Least distance of the vertices of either part to the other part's surface."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
    if (low - high).max() > _GAP * whole:
        return float((low - high).max())  # the boxes are farther apart than that
    ways = []
    for points, surface in ((one.vertices, other), (other.vertices, one)):
        near = ((points > low - _GAP * whole) & (points < high + _GAP * whole)).all(axis=1)
        some = points[near][:: max(1, int(near.sum()) // _SAMPLES)]
        if len(some):
            ways.append(float(RayScene(surface.vertices, surface.faces).distance(some).min()))
    return min(ways, default=np.inf)


def _middle(vertices: NDArray[np.floating]) -> NDArray[np.float64]:
    return (vertices.max(axis=0).astype(np.float64) + vertices.min(axis=0)) / 2

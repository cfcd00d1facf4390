"""Cleaning of scans: unit, doubled vertices, orientation of faces, size, and a check for one person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.remesh import cluster, simplify
from stages.shared.meshes.topology import components, face_normals, keep_faces
from stages.shared.report import Report

# Metres per unit: metre, centimetre, millimetre, inch, foot.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_SHORTEST, _LONGEST = 1.2, 2.4  # largest side of a person's box, metres
_WELD = 1e-6  # of the mesh's size
_CLUSTERED_FROM = 3  # times the most faces: edge collapse takes minutes beyond
_RAYS = 6  # to either side of a face
_FACES_ASKED = 20_000
_LIFT_M = 5e-4


@dataclass(frozen=True, eq=False)
class CleanScan:
    """A mesh in metres, one person, faces outward; and what had to be done (for the report)."""

    mesh: Mesh
    report: dict[str, Any]


def clean_scan(mesh: Mesh, most_faces: int, where: str, report: Report) -> CleanScan:
    """Make a scan usable, and say what was wrong with it.

    Arguments:
        mesh: any of `UNITS`; holes are left as they are.
        most_faces: a larger scan is simplified to about as many.

    Raises:
        BadData: not the size of a person in any unit; two people.
    """
    mesh, welded, dropped = weld(mesh)
    if not len(mesh.faces):
        raise BadData("No face of the mesh has an area.", where, "Export the mesh again.")
    refuse_two_people(mesh, where)
    unit, metres = unit_of(mesh, where)
    if unit != "m":
        report.warn(f"the scan is in {unit}; it is taken times {metres:g}")
        mesh = replace(mesh, vertices=(metres * mesh.vertices.astype(np.float64)).astype(np.float32))
    method = "unchanged"
    if len(mesh.faces) > _CLUSTERED_FROM * most_faces:
        mesh, method = cluster(mesh, 2 * most_faces), "clustered"
    mesh, flipped = outward_faces(mesh)
    if flipped:
        report.say(f"{flipped} of {len(mesh.faces)} faces were turned inside out")
    mesh, simplified = simplify(mesh, most_faces)
    if method == "clustered" or simplified != "unchanged":
        report.say(f"the scan is simplified to {len(mesh.faces)} faces")
    content = {
        "unit": unit,
        "metres_per_unit": metres,
        "doubled_vertices": welded,
        "faces_without_area_or_doubled": dropped,
        "faces_turned": flipped,
        "simplified": simplified if method == "unchanged" else f"{method}, {simplified}",
    }
    return CleanScan(mesh, content)


def unit_of(mesh: Mesh, where: str) -> tuple[str, float]:
    """The unit in which the mesh is as large as a person, metres first, and its metres."""
    size = float((mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).max())
    for name, metres in UNITS.items():
        if _SHORTEST <= size * metres <= _LONGEST:
            return name, metres
    raise BadData(
        f"The mesh is {size:.4g} units large: a person's size in none of the units {', '.join(UNITS)}.",
        where,
        "Scale the mesh to metres, or cut away what is not the person.",
    )


def weld(mesh: Mesh) -> tuple[Mesh, int, int]:
    """Vertices at one place made one, faces without area or stated twice left out; how many of either."""
    size = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-12)
    keys = np.rint(mesh.vertices.astype(np.float64) / (_WELD * size)).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[mesh.faces]
    corners = np.sort(faces, axis=1)
    area = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])
    _, once = np.unique(corners, axis=0, return_index=True)
    keep = np.zeros(len(faces), bool)
    keep[once] = True
    keep &= area
    # The order of the vertices stays, so that a clean scan is left as it is.
    order = np.argsort(first)
    rank = np.empty(len(first), np.int64)
    rank[order] = np.arange(len(first))
    rows = first[order]
    welded = Mesh(
        mesh.vertices[rows],
        rank[faces[keep]].astype(np.int32),
        None if mesh.colors is None else mesh.colors[rows],
        None if mesh.labels is None else mesh.labels[rows],
    )
    return welded, len(mesh.vertices) - len(rows), int((~keep).sum())


def outward_faces(mesh: Mesh, seed: int = 0) -> tuple[Mesh, int]:
    """The mesh with its faces turned outward, and how many had to be turned.

    Neighbouring faces are made to agree; each connected patch is then turned to the side from which more rays
    escape, so a few faces in a fold do not decide.
    """
    agreeing, patch = igl.bfs_orient(np.ascontiguousarray(mesh.faces, dtype=np.int64))
    patch = np.asarray(patch).reshape(-1)
    normals, areas = face_normals(mesh.vertices, agreeing)
    random = np.random.default_rng(seed)
    some = random.permutation(len(agreeing))[:_FACES_ASKED]
    small = np.unique(patch, return_index=True)[1]  # every patch is asked at least once
    some = np.unique(np.concatenate([some, small]))
    middles = mesh.vertices[agreeing[some]].astype(np.float64).mean(axis=1)
    scene = RayScene(mesh.vertices, mesh.faces)
    free = np.zeros((2, len(some)), np.int32)
    for direction in random.normal(size=(_RAYS, 3)):
        direction /= np.linalg.norm(direction)
        upward = np.where((normals[some] @ direction)[:, None] > 0, direction, -direction)
        for side, sign in enumerate((1.0, -1.0)):
            rays = sign * (upward + 0.5 * normals[some])
            free[side] += ~scene.first_hits(middles + sign * _LIFT_M * normals[some], rays).hit
    votes = np.bincount(patch[some], (free[0] - free[1]) * areas[some], minlength=patch.max() + 1)
    faces = np.where((votes < 0)[patch][:, None], agreeing[:, ::-1], agreeing)
    before = face_normals(mesh.vertices, mesh.faces)[0]
    turned = np.einsum("fc,fc->f", face_normals(mesh.vertices, faces)[0], before) < 0
    # Faces that keep their side keep the order of their corners, too.
    unflipped = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return replace(mesh, faces=unflipped), int(turned.sum())


# Shares of the mesh: the smallest area of a part that is checked, and the gap below which two parts belong
# together. Then height, area and distance (between centres) of two people.
_PART_AREA, _GAP = 0.01, 0.03
_PERSON_TALL, _PERSON_AREA, _APART = 0.5, 0.2, 0.15
_MOST_PARTS = 40
_SAMPLES = 3000
_STANDING = 1.5  # ratio of height to width of a standing person


def refuse_two_people(mesh: Mesh, where: str) -> None:
    """Raise BadData when a mesh shows two people side by side.

    Layered scans and modelling tools give jacket, trousers, shirt and skin as separate surfaces. Such parts
    lie within a few centimetres of each other, one above or around the other. Two people leave a gap between
    them, or stand side by side.
    """
    size = float(np.ptp(mesh.vertices, axis=0).max())
    parts, areas = _large_parts(mesh)
    group = _belonging_together(parts, size)
    people = []
    for number in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == number)
        vertices = np.concatenate([parts[member].vertices for member in members])
        tall = np.ptp(vertices, axis=0).max() > _PERSON_TALL * size
        if tall and areas[members].sum() > _PERSON_AREA:
            people.append(_middle(vertices))
    for place, one in enumerate(people):
        for other in people[place + 1 :]:
            apart = np.linalg.norm(one - other)
            if apart > _APART * size:
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


def _belonging_together(parts: list[Mesh], size: float) -> NDArray[np.int32]:
    """(P,) group number of every part: parts with a small gap between them that are not abreast."""
    first, second = [], []
    for one in range(len(parts)):
        for other in range(one + 1, len(parts)):
            if _abreast(parts[one].vertices, parts[other].vertices, size):
                continue
            if _gap(parts[one], parts[other], size) < _GAP * size:
                first.append(one)
                second.append(other)
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(len(parts), len(parts)))
    return np.asarray(connected_components(links, directed=False)[1], np.int32)


def _abreast(one: NDArray[np.floating], other: NDArray[np.floating], size: float) -> bool:
    """Whether two parts are both tall and slim, as tall as the mesh, and side by side."""
    apart = np.abs(_middle(one) - _middle(other))
    across = int(apart.argmax())
    up = int(np.argsort(np.where(np.arange(3) == across, -1, np.ptp(one, axis=0)))[-1])
    sizes = np.stack([np.ptp(one, axis=0), np.ptp(other, axis=0)])
    standing = (sizes[:, up] > _STANDING * sizes[:, across]) & (sizes[:, up] > _PERSON_TALL * size)
    return bool(standing.all() and apart[across] > _APART * size)


def _gap(one: Mesh, other: Mesh, size: float) -> float:
    """Least distance of the vertices of either part to the other part's surface."""
    low = np.maximum(one.vertices.min(axis=0), other.vertices.min(axis=0))
    high = np.minimum(one.vertices.max(axis=0), other.vertices.max(axis=0))
    if (low - high).max() > _GAP * size:
        return float((low - high).max())  # the boxes are farther apart than that
    ways = []
    for points, surface in ((one.vertices, other), (other.vertices, one)):
        near = ((points > low - _GAP * size) & (points < high + _GAP * size)).all(axis=1)
        some = points[near][:: max(1, int(near.sum()) // _SAMPLES)]
        if len(some):
            ways.append(float(RayScene(surface.vertices, surface.faces).distance(some).min()))
    return min(ways, default=np.inf)


def _middle(vertices: NDArray[np.floating]) -> NDArray[np.float64]:
    return (vertices.max(axis=0).astype(np.float64) + vertices.min(axis=0)) / 2

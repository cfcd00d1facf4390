"""The moving surfaces that cloth rests on: the body, and the garments beneath."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.cloth.constraints import area_normals
from stages.shared.meshes import RayScene, face_normals

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]

REACH = 0.10  # metres: cloth farther from a surface than this cannot arrive within a frame


@dataclass(eq=False)
class Surface:
    """A triangle surface whose vertices move.

    Attributes:
        faces: (F, 3) triangles, counter-clockwise seen from outside.
        closed: True for a body, which always pushes outward; False for a garment, which has rims.
        friction: Coulomb coefficient.
        first: (V+1,) and incident: the faces around each vertex.
        touchable: (V,) vertices that have a face.
    """

    faces: Indices
    vertex_count: int
    closed: bool
    friction: float
    first: Indices = field(init=False)
    incident: Indices = field(init=False)
    touchable: NDArray[np.int64] = field(init=False)
    _longest_edge: float | None = None

    def __post_init__(self) -> None:
        self.faces = np.ascontiguousarray(self.faces, dtype=np.int32)
        corner = self.faces.ravel()
        self.incident = (np.argsort(corner, kind="stable") // 3).astype(np.int32)
        counts = np.bincount(corner, minlength=self.vertex_count)
        self.first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self.touchable = np.flatnonzero(counts)

    def seeds(self, vertices: Doubles, points: Doubles, reach: float = REACH) -> Indices:
        """(N,) a face around the nearest vertex of the surface for every point; −1 beyond reach."""
        if not len(self.touchable):
            return np.full(len(points), -1, dtype=np.int32)
        if self._longest_edge is None:  # a point near a large face may be far from its corners
            ends = vertices[self.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2, 3)
            self._longest_edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max())
        tree = cKDTree(vertices[self.touchable])
        distance, index = tree.query(points, distance_upper_bound=reach + self._longest_edge)
        near = np.isfinite(distance)
        vertex = self.touchable[np.where(near, index, 0)]
        return np.where(near, self.incident[self.first[vertex]], -1).astype(np.int32)


class Surfaces(NamedTuple):
    """Several surfaces within one frame, packed for the kernels (S surfaces, M vertices, F faces in all).

    Attributes:
        before, after: (M, 3) metres, at the start and at the end of the frame.
        normals_before, normals_after: (M, 3) unit.
        faces: (F, 3); first: (M+1,); incident: faces around each vertex.
        closed: (S,); friction: (S,).
        seeds: (S, V) a face near each cloth vertex, −1 for none; followed by the kernel.
        margins: (S, V) metres to keep from each surface.
    """

    before: Doubles
    after: Doubles
    normals_before: Doubles
    normals_after: Doubles
    faces: Indices
    first: Indices
    incident: Indices
    closed: NDArray[np.bool_]
    friction: Doubles
    seeds: Indices
    margins: Doubles


@dataclass(frozen=True, eq=False)
class Moving:
    """A surface within one frame: (V, 3) metres and unit normals at its start and its end."""

    surface: Surface
    before: Doubles
    after: Doubles
    normals_before: Doubles
    normals_after: Doubles


def moving(surface: Surface, before: Doubles, after: Doubles) -> Moving:
    """The surface moving from one place to the next, with its normals."""
    return Moving(
        surface, before, after, area_normals(before, surface.faces), area_normals(after, surface.faces)
    )


def pack_surfaces(surfaces: list[Moving], points: Doubles, margins: list[Doubles]) -> Surfaces:
    """All surfaces that a garment may touch within a frame.

    Arguments:
        points: (V, 3) the garment at the start of the frame.
        margins: for every surface (V,) metres to keep from it.
    """
    count = len(points)
    if not surfaces:
        empty, none = np.zeros((0, 3)), np.zeros(0, dtype=np.int32)
        return Surfaces(
            empty, empty, empty, empty, np.zeros((0, 3), np.int32), np.zeros(1, np.int32), none,
            np.zeros(0, bool), np.zeros(0), np.zeros((0, count), np.int32), np.zeros((0, count)),
        )  # fmt: skip
    vertex_offsets = np.cumsum([0] + [one.surface.vertex_count for one in surfaces])
    face_offsets = np.cumsum([0] + [len(one.surface.faces) for one in surfaces])
    corner_offsets = 3 * face_offsets
    first = [
        one.surface.first[:-1] + offset for one, offset in zip(surfaces, corner_offsets[:-1], strict=True)
    ]
    seeds = [one.surface.seeds(one.before, points) for one in surfaces]
    return Surfaces(
        np.concatenate([one.before for one in surfaces]),
        np.concatenate([one.after for one in surfaces]),
        np.concatenate([one.normals_before for one in surfaces]),
        np.concatenate([one.normals_after for one in surfaces]),
        np.concatenate(
            [one.surface.faces + v for one, v in zip(surfaces, vertex_offsets[:-1], strict=True)]
        ).astype(np.int32),
        np.concatenate([*first, corner_offsets[-1:]]).astype(np.int32),
        np.concatenate(
            [one.surface.incident + f for one, f in zip(surfaces, face_offsets[:-1], strict=True)]
        ).astype(np.int32),
        np.array([one.surface.closed for one in surfaces]),
        np.array([one.surface.friction for one in surfaces], dtype=np.float64),
        np.stack([np.where(s >= 0, s + f, -1) for s, f in zip(seeds, face_offsets[:-1], strict=True)]).astype(
            np.int32
        ),
        np.stack(margins).astype(np.float64),
    )


def template_margins(points: NDArray, body: NDArray, faces: NDArray, most: float, least: float) -> Doubles:
    """(V,) metres that a garment keeps from the body: its distance in the template, within two bounds.

    Arguments:
        points: (V, 3) the garment; body: (B, 3) with faces (F, 3), both in the template's pose.
    """
    closest, face, _ = RayScene(body, faces).closest(points)
    normals = face_normals(body, faces)[0][face]
    return np.clip(((points - closest) * normals).sum(axis=1), least, most).astype(np.float64)

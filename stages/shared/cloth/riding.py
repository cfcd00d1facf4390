"""Fine points that ride on a simulation mesh: texels of a garment follow the nearest triangle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stages.shared.cloth.constraints import area_normals
from stages.shared.meshes import RayScene

Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Riding:
    """Where points sit on a mesh.

    Attributes:
        face: (N,) i32 nearest face.
        barycentric: (N, 3) f32 weights of its corners.
        offset: (N, 3) f32 metres along the first edge, across it, and along the normal.
    """

    face: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    offset: NDArray[np.float32]


def ride(points: NDArray, vertices: NDArray, faces: NDArray) -> Riding:
    """How points (N, 3) sit on a mesh (V, 3), (F, 3) in the same pose, metres."""
    points = np.asarray(points, dtype=np.float64)
    _, face, barycentric = RayScene(vertices, faces).closest(points)
    base, frames = places(Riding(face, barycentric, np.zeros((len(points), 3), np.float32)), vertices, faces)
    offset = np.einsum("nji,nj->ni", frames, points - base)
    return Riding(face.astype(np.int32), barycentric.astype(np.float32), offset.astype(np.float32))


def places(riding: Riding, vertices: NDArray, faces: NDArray) -> tuple[Doubles, Doubles]:
    """Points (N, 3) on the surface, without their offsets, and the rotations (N, 3, 3) of their frames.

    The columns of a frame are the direction of the face's first edge, the one across it, and the normal. The
    normal is that of the vertices, weighted, so that it does not jump from face to face.
    """
    points = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(faces)[riding.face]
    weights = riding.barycentric.astype(np.float64)
    corners = points[triangles]
    base = np.einsum("nk,nkc->nc", weights, corners)
    normal = np.einsum("nk,nkc->nc", weights, area_normals(points, np.asarray(faces))[triangles])
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lost = np.linalg.norm(normal, axis=1, keepdims=True) < 0.1
    normal = _unit(np.where(lost, flat, normal))
    along = corners[:, 1] - corners[:, 0]
    along = _unit(along - (along * normal).sum(axis=1, keepdims=True) * normal)
    return base, np.stack([along, np.cross(normal, along), normal], axis=2)


def ridden(riding: Riding, vertices: NDArray, faces: NDArray) -> tuple[Doubles, Doubles]:
    """Where the points are on the mesh now: positions (N, 3), and frames (N, 3, 3) as in `places`."""
    base, frames = places(riding, vertices, faces)
    return base + np.einsum("nij,nj->ni", frames, riding.offset.astype(np.float64)), frames


def averaging(riding: Riding, faces: NDArray, vertex_count: int) -> sparse.csr_array:
    """(V, N) matrix that averages values at the points to the vertices of the mesh; rows sum to 1 or 0."""
    triangles = np.asarray(faces)[riding.face]
    columns = np.repeat(np.arange(len(riding.face)), 3)
    weights = np.maximum(riding.barycentric.astype(np.float64), 0.0).ravel()
    matrix = sparse.csr_array((weights, (triangles.ravel(), columns)), shape=(vertex_count, len(riding.face)))
    total = np.asarray(matrix.sum(axis=1)).ravel()
    return sparse.csr_array(sparse.diags_array(1.0 / np.where(total > 0, total, 1.0)) @ matrix)


def _unit(vectors: Doubles) -> Doubles:
    return vectors / (np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-20)

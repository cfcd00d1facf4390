"""One sheet from a garment in pieces: a scan ends where another garment begins, cloth does not.

The visible part of a shirt and its part under a vest come from different surfaces of the template. So do a
skirt and its waist under a shirt. Simulated apart, the pieces would separate. Screened Poisson
reconstruction (Kazhdan and Hoppe 2013, in open3d) lays one closed surface through the oriented faces of all
pieces. It is remeshed while it is closed, so that its rims have no short edges. What lies on a piece remains,
and what lies between two pieces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.shared.meshes import Mesh, RayScene, components, face_normals, keep_faces
from stages.shared.meshes.raycast import load_open3d
from stages.shared.meshes.remesh import remesh

Doubles = NDArray[np.float64]
Indices = NDArray[np.int32]

SMALLEST_PIECE = 0.01  # of all faces; smaller pieces are scan noise
WIDEST_GAP = 0.04  # m between two pieces that are joined
_ON_PIECE = 0.006  # m
_SAMPLE_SPACING = 0.006  # m
_DEPTH = 7  # of the octree: 1 cm in a garment of 1.3 m


def weld(vertices: Doubles, faces: Indices, edge: float) -> tuple[Doubles, Indices]:
    """The garment as one sheet where gaps are at most `WIDEST_GAP` wide; unchanged if it is one already.

    Arguments:
        vertices: (V, 3) m. faces: (F, 3), oriented outwards. edge: target edge length of a welded sheet, m.

    Returns:
        vertices (V', 3) f64 m, faces (F', 3) i32.
    """
    pieces = large_pieces(faces, len(vertices))
    if len(pieces) < 2:
        return vertices, faces
    closed = Mesh(*_poisson_surface(vertices, np.concatenate(pieces)))
    even, _ = remesh(closed, edge / 2, close_holes=False)
    points, triangles = even.vertices.astype(np.float64), even.faces
    centres = points[triangles].mean(axis=1)
    to_pieces = np.stack([RayScene(vertices, piece).closest(centres)[0] for piece in pieces]) - centres
    distances = np.linalg.norm(to_pieces, axis=2)
    on_piece = distances.min(axis=0) < _ON_PIECE
    kept, used = keep_faces(triangles, on_piece | _between(to_pieces, distances), len(points))
    return points[used], kept


def large_pieces(faces: Indices, vertex_count: int) -> list[Indices]:
    """Faces (K, 3) of every connected piece that holds at least `SMALLEST_PIECE` of all faces."""
    piece = components(faces, vertex_count)[faces[:, 0]]
    sizes = np.bincount(piece)
    return [faces[piece == number] for number in np.flatnonzero(sizes >= SMALLEST_PIECE * len(faces))]


def _between(to_pieces: Doubles, distances: Doubles) -> NDArray[np.bool_]:
    """(K,) whether a point lies in a gap: its two nearest pieces are near and on opposite sides of it.

    Arguments:
        to_pieces: (P, K, 3) m from each point to the nearest point of each piece. distances: their lengths.
    """
    nearest = np.argsort(distances, axis=0, kind="stable")[:2]
    columns = np.arange(distances.shape[1])
    first, second = to_pieces[nearest[0], columns], to_pieces[nearest[1], columns]
    width = distances[nearest[0], columns] + distances[nearest[1], columns]
    return np.asarray((np.einsum("kc,kc->k", first, second) < 0) & (width < WIDEST_GAP))


def _poisson_surface(vertices: Doubles, faces: Indices) -> tuple[NDArray[np.float32], Indices]:
    """A closed surface through the centres of the faces, with their normals."""
    open3d = load_open3d()
    normals, areas = face_normals(vertices, faces)
    solid = areas > 0
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(vertices[faces[solid]].mean(axis=1)))
    cloud.normals = open3d.utility.Vector3dVector(normals[solid].astype(np.float64))
    cloud = cloud.voxel_down_sample(_SAMPLE_SPACING)
    # One thread: the same bytes in every run.
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=_DEPTH, n_threads=1)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.triangles).astype(np.int32)

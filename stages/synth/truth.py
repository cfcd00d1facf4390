"""The true meshes, which no real capture has, and the scan of the first frame."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.shared.body.poses import npz_bytes
from stages.shared.meshes import Mesh, RayScene, edges, keep_faces, vertex_normals
from stages.shared.meshes.ply import encode_ply
from stages.shared.pictures.srgb import srgb_from_linear
from stages.synth.dressed import Look
from stages.synth.garments import Garment
from stages.synth.textures import fabric_color

Doubles = NDArray[np.float64]
Faces = NDArray[np.int64]

_GARMENT_SUBDIVISIONS = 2  # cloth triangles of 17 mm become 4 mm, fine enough for the patterns
_RAY_START = 0.002


def garment_truth(garments: list[Garment], cloth: list[NDArray[np.float32]], frames: list[int]) -> bytes:
    """Content of `gt/meshes.npz`: simulated garments of the frames that have images.

    Keys: `frames` (T,) i32; per layer `<layer>_v` (T, V, 3) f32 metres world, `<layer>_f` (F, 3) i32,
    `<layer>_uv` (F, 3, 2) f32 metres, `<layer>_rest` (V, 3) f32 metres rest frame, unstretched.
    """
    arrays: dict[str, NDArray] = {"frames": np.asarray(frames, dtype=np.int32)}
    for garment, positions in zip(garments, cloth, strict=True):
        arrays[f"{garment.layer}_v"] = positions[frames]
        arrays[f"{garment.layer}_f"] = garment.faces.astype(np.int32)
        arrays[f"{garment.layer}_uv"] = garment.corner_uv.astype(np.float32)
        arrays[f"{garment.layer}_rest"] = garment.vertices.astype(np.float32)
    return npz_bytes(arrays)


def scan(look: Look, vertices: Doubles) -> bytes:
    """Content of `scan.ply`: what a scanner sees of the dressed person, with albedo and a label per vertex.

    Arguments:
        vertices: (V, 3) metres, world, in the order of `look`.
    """
    is_cloth = look.face_fabric > 0
    garment_faces, garment_uv = look.faces[is_cloth], look.corner_uv[is_cloth]
    points, faces, uv, parent = subdivided(vertices, garment_faces, garment_uv, _GARMENT_SUBDIVISIONS)
    rows = look.face_fabric[is_cloth][parent]
    body_faces = look.faces[~is_cloth]
    offset = len(vertices)
    all_points = np.concatenate([vertices, points])
    all_faces = np.concatenate([body_faces, faces + offset])
    colors = np.concatenate([look.vertex_colors, _corner_colors(len(points), faces, uv, rows, look.fabrics)])
    labels = np.concatenate([look.vertex_label, np.zeros(len(points), np.uint8)])
    labels[offset + faces] = look.face_label[is_cloth][parent][:, None]
    visible = _visible_from_outside(look, vertices, all_points, all_faces)
    visible_faces, used = keep_faces(all_faces, visible[all_faces].any(axis=1), len(all_points))
    mesh = Mesh(
        all_points[used].astype(np.float32),
        visible_faces,
        np.round(255 * srgb_from_linear(colors[used])).astype(np.uint8),
        labels[used],
    )
    return b"".join(encode_ply(mesh, vertex_normals(all_points, all_faces)[used]))


def subdivided(
    vertices: Doubles, faces: Faces, corner_uv: Doubles, times: int
) -> tuple[Doubles, Faces, Doubles, NDArray[np.int64]]:
    """Each triangle cut into four, `times` times; also (F',) the original triangle of each new one."""
    used, inverse = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], inverse.reshape(faces.shape)
    parent = np.arange(len(faces))
    for _ in range(times):
        pairs = edges(faces).astype(np.int64)
        key = pairs[:, 0] * len(vertices) + pairs[:, 1]
        middles = []
        for a, b in ((0, 1), (1, 2), (2, 0)):
            side = np.sort(faces[:, [a, b]], axis=1)
            middles.append(len(vertices) + np.searchsorted(key, side[:, 0] * len(vertices) + side[:, 1]))
        ab, bc, ca = middles
        a, b, c = faces.T
        uv_a, uv_b, uv_c = corner_uv[:, 0], corner_uv[:, 1], corner_uv[:, 2]
        uv_ab, uv_bc, uv_ca = 0.5 * (uv_a + uv_b), 0.5 * (uv_b + uv_c), 0.5 * (uv_c + uv_a)
        vertices = np.concatenate([vertices, 0.5 * (vertices[pairs[:, 0]] + vertices[pairs[:, 1]])])
        corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        uvs = [(uv_a, uv_ab, uv_ca), (uv_ab, uv_b, uv_bc), (uv_ca, uv_bc, uv_c), (uv_ab, uv_bc, uv_ca)]
        faces = np.concatenate([np.stack(three, axis=1) for three in corners])
        corner_uv = np.concatenate([np.stack(three, axis=1) for three in uvs])
        parent = np.tile(parent, 4)
    return vertices, faces, corner_uv, parent


@njit(cache=True, nogil=True)
def _corner_colors(count, faces, corner_uv, rows, fabrics):  # type: ignore[no-untyped-def]
    """(V, 3) linear albedo of vertices, at the texture coordinates of one of their corners."""
    colors = np.zeros((count, 3))
    for f in range(len(faces)):
        for k in range(3):
            fabric_color(fabrics[rows[f]], corner_uv[f, k, 0], corner_uv[f, k, 1], colors[faces[f, k]])
    return colors


def _visible_from_outside(look: Look, vertices: Doubles, points: Doubles, faces: Faces) -> NDArray[np.bool_]:
    """(V,) whether a vertex sees any of 49 directions around and above the person, on its outer side."""
    scene = RayScene(vertices, look.faces)
    normals = vertex_normals(points, faces).astype(np.float64)
    azimuth = np.tile(2 * np.pi * np.arange(16) / 16, 3)
    elevation = np.repeat(np.radians([-25.0, 5.0, 40.0]), 16)
    directions = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=-1
    )
    directions = np.concatenate([directions, [[0.0, 1.0, 0.0]]])
    visible = np.zeros(len(points), dtype=bool)
    for direction in directions:
        ask = np.flatnonzero(~visible & (normals @ direction > 0.1))
        starts = points[ask] + _RAY_START * normals[ask]
        visible[ask] = ~scene.first_hits(starts, direction).hit
    return visible

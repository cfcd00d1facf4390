"""Cloth that no camera saw lies on the body, not where the garment over it hangs.

A template is the outermost surface. A shirt that continues under a jacket borrows the jacket's faces
(`extract.faces_beneath`). The jacket may hang centimetres away from the body, so the borrowed vertices are
lowered: each moves to the point of the body below it, at the distance that the visible part of the shirt
keeps near its border. The result is between the body and the cover, and as tight as the visible part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from stages.shared.fields.diffusion import conjugate_gradient, graph_laplacian
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.regions import mesh_edges
from stages.shared.meshes.topology import vertex_normals

_CLEARANCE = 0.002  # m, least distance to the body
_LEAST_MOVE = 0.001  # m; cloth that already lies this near to its place keeps it
_GAP = 0.01  # m between a cover and the visible cloth next to it
_SCREEN = 1e-6  # pull of the median distance on pieces that touch no visible part


@dataclass(frozen=True)
class BodySurface:
    """The body model's mesh in the template's frame and in canonical space, with the same vertices.

    Attributes:
        world: (V, 3) float64 m. canonical: (V, 3) m, zero shape. faces: (F, 3).
        skin_weights: (V, 55). shape_directions: (V, 10, 3) m per unit of shape, canonical.
    """

    world: np.ndarray
    canonical: np.ndarray
    faces: np.ndarray
    skin_weights: np.ndarray
    shape_directions: np.ndarray


@dataclass(frozen=True)
class LoweredCloth:
    """Vertices after lowering: world and canonical positions, and what the body has there.

    Attributes:
        world, canonical: (V, 3) m. skin_weights: (V, 55). shape_directions: (V, 10, 3).
        folded: (F,) bool, faces that lie upside down after lowering; they belong to flaps of the cover.
    """

    world: np.ndarray
    canonical: np.ndarray
    skin_weights: np.ndarray
    shape_directions: np.ndarray
    folded: np.ndarray


def lower_onto_body(
    world: np.ndarray,
    canonical: dict[str, np.ndarray],
    faces: np.ndarray,
    hidden: np.ndarray,
    body: BodySurface,
) -> LoweredCloth:
    """Lower the hidden vertices of a garment onto the body; visible ones stay.

    Hidden vertices that are nearer to the body than the visible part's distance stay, too.

    Arguments:
        world: (V, 3) m, template frame. canonical: `vertices` (V, 3), `skin_weights`, `shape_directions`.
        faces: (F, 3). hidden: (V,) bool.
    """
    scene = RayScene(body.world, body.faces)
    closest, face, barycentric = scene.closest(world)
    distance = np.linalg.norm(world - closest, axis=1)
    usual = continued_distance(world, faces, distance, hidden)
    lowered = np.maximum(usual, _CLEARANCE)[:, None]
    moving = hidden & (usual < distance - _LEAST_MOVE)
    corners = body.faces[face]

    def at_body(values: np.ndarray) -> np.ndarray:
        return np.einsum("vk,vk...->v...", barycentric, values[corners])

    def above_body(vertices: np.ndarray) -> np.ndarray:
        normals = at_body(vertex_normals(vertices, body.faces).astype(np.float64))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        return at_body(vertices.astype(np.float64)) + lowered * normals

    def replaced(values: np.ndarray, by: np.ndarray) -> np.ndarray:
        mask = moving.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(mask, by, values).astype(values.dtype)

    moved = replaced(world, above_body(body.world))
    outward = at_body(vertex_normals(body.world, body.faces).astype(np.float64))[faces].mean(axis=1)
    edges = moved[faces[:, 1:]] - moved[faces[:, :1]]
    turned = np.einsum("fk,fk->f", np.cross(edges[:, 0], edges[:, 1]), outward) <= 0
    return LoweredCloth(
        moved,
        replaced(canonical["vertices"], above_body(body.canonical)),
        replaced(canonical["skin_weights"], at_body(body.skin_weights)),
        replaced(canonical["shape_directions"], at_body(body.shape_directions)),
        turned & moving[faces].all(axis=1),
    )


def continued_distance(
    vertices: np.ndarray, faces: np.ndarray, distance: np.ndarray, hidden: np.ndarray
) -> np.ndarray:
    """(V,) m: `distance` where visible; elsewhere its harmonic continuation over the mesh.

    A cover that is a separate piece of the scan is linked to the visible vertices that it lies next to.

    Arguments:
        vertices: (V, 3). faces: (F, 3). distance: (V,) m to the body. hidden: (V,) bool.
    """
    if not hidden.any():
        return distance
    visible = np.flatnonzero(~hidden)
    median = float(np.median(distance[visible])) if len(visible) else _CLEARANCE
    edges = np.concatenate([mesh_edges(vertices, faces), _links_across(vertices, hidden)])
    laplacian = graph_laplacian(edges, len(vertices))
    unknown = np.flatnonzero(hidden)
    matrix = (laplacian[unknown][:, unknown] + _SCREEN * sparse.identity(len(unknown))).tocsr()
    right = -(laplacian[unknown][:, visible] @ distance[visible]) + _SCREEN * median
    result = distance.astype(np.float64).copy()
    start = np.full((len(unknown), 1), median)
    result[unknown] = conjugate_gradient(matrix, right[:, None], start, 1e-6, 2000)[:, 0]
    return result


def _links_across(vertices: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """(E, 2) a link from each hidden vertex to the nearest visible one within `_GAP`."""
    below, visible = np.flatnonzero(hidden), np.flatnonzero(~hidden)
    if not len(visible):
        return np.zeros((0, 2), np.int64)
    apart, nearest = cKDTree(vertices[visible]).query(vertices[below], distance_upper_bound=_GAP)
    near = np.isfinite(apart)
    return np.stack([below[near], visible[nearest[near]]], axis=1)

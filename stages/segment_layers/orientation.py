"""Which way is out: pieces of a scan that are stored inside out are turned."""

from __future__ import annotations

import numpy as np

from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import components, vertex_normals

_LIFT = 1e-3  # metres


def outward_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F, 3), those of every inside-out connected piece with their corners swapped.

    From the outside of a surface most rays along the normal leave the scene; from the inside they meet it
    again. A piece is turned when more of its vertices are free behind than before.
    """
    normals = vertex_normals(vertices, faces).astype(np.float64)
    scene = RayScene(vertices, faces)
    before = ~scene.first_hits(vertices + _LIFT * normals, normals).hit
    behind = ~scene.first_hits(vertices - _LIFT * normals, -normals).hit
    piece = components(faces, len(vertices))
    surplus = np.bincount(piece, before.astype(float) - behind)
    inside_out = surplus[piece[faces[:, 0]]] < 0
    return np.where(inside_out[:, None], faces[:, ::-1], faces)

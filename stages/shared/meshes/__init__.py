"""Triangle meshes: files, checks, topology, ray casting, clean-up."""

from stages.shared.meshes.load import load_mesh, write_ply
from stages.shared.meshes.mesh import Mesh, check_mesh
from stages.shared.meshes.raycast import Hits, RayScene
from stages.shared.meshes.topology import (
    adjacency,
    boundary_edges,
    components,
    edges,
    face_normals,
    keep_faces,
    vertex_normals,
)

__all__ = [
    "Hits",
    "Mesh",
    "RayScene",
    "adjacency",
    "boundary_edges",
    "check_mesh",
    "components",
    "edges",
    "face_normals",
    "keep_faces",
    "load_mesh",
    "vertex_normals",
    "write_ply",
]

"""Mesh clean-up and remeshing by pymeshlab, in a child process with a time limit; libigl where that fails.

pymeshlab is known to crash at import on some systems, and its filters can hang on broken meshes. The child,
this same module run as a program, gets arrays in a temporary folder and gives arrays back.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.topology import components, keep_faces

Doubles = NDArray[np.float64]

_TIME_LIMIT_SECONDS = 120.0
_SMALLEST_EDGE = 1e-5
_MOST_HOLE_EDGES = 80


def remesh(
    mesh: Mesh, edge: float, time_limit: float = _TIME_LIMIT_SECONDS, close_holes: bool = True
) -> tuple[Mesh, str]:
    """The same surface with triangles of even size: no doubles, no non-manifold edges.

    Arguments:
        mesh: its colours and labels are taken over from the nearest vertex.
        edge: target edge length, metres, > 0.
        time_limit: seconds that pymeshlab may take.
        close_holes: close holes of up to 80 edges; a garment's neck and sleeves are such holes.

    Returns:
        The new mesh and the method: "pymeshlab" or "libigl".
    """
    area = _area(mesh)
    # An equilateral triangle of edge e has the area √3/4 e².
    task = "remesh" if close_holes else "remesh-open"
    return _make(mesh, task, max(edge, _SMALLEST_EDGE), int(area / (0.433 * edge * edge)), time_limit)


def simplify(mesh: Mesh, most_faces: int, time_limit: float = _TIME_LIMIT_SECONDS) -> tuple[Mesh, str]:
    """The same surface with at most about `most_faces` faces; arguments and result as in `remesh`."""
    if len(mesh.faces) <= most_faces:
        return mesh, "unchanged"
    return _make(mesh, "simplify", float(most_faces), most_faces, time_limit)


def cluster(mesh: Mesh, about_faces: int) -> Mesh:
    """The mesh with its vertices drawn together in the cells of a grid: coarse, but fast on many faces.

    Every cell keeps the vertex nearest to the mean of those in it, with its colour and label (Rossignac and
    Borrel 1993). The cells are chosen so that about `about_faces` faces are left.
    """
    # A surface of area A meets about 2 A / h² cells of side h well enough to leave two faces in each.
    side = np.sqrt(2.0 * _area(mesh) / max(about_faces, 1))
    keys = np.floor(mesh.vertices.astype(np.float64) / side).astype(np.int64)
    _, inverse, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    sums = np.stack([np.bincount(inverse, mesh.vertices[:, axis]) for axis in range(3)], axis=1)
    means = sums / counts[:, None]
    distance = np.linalg.norm(mesh.vertices - means[inverse], axis=1)
    order = np.lexsort((distance, inverse))
    rows = order[np.r_[0, np.cumsum(counts)[:-1]]]
    faces = inverse[mesh.faces]
    corners = np.sort(faces, axis=1)
    faces = faces[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])]
    faces = faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
    return Mesh(
        mesh.vertices[rows],
        faces,
        None if mesh.colors is None else mesh.colors[rows],
        None if mesh.labels is None else mesh.labels[rows],
    )


def _make(mesh: Mesh, task: str, amount: float, target_faces: int, time_limit: float) -> tuple[Mesh, str]:
    result = _in_child(mesh, task, amount, time_limit)
    method = "pymeshlab"
    if result is None:
        result, method = _with_libigl(mesh, target_faces), "libigl"
    return _carry_over(mesh, *result), method


def _in_child(mesh: Mesh, task: str, amount: float, time_limit: float) -> tuple[Doubles, NDArray] | None:
    """Vertices and faces from the child process, or None when it failed for any reason."""
    with tempfile.TemporaryDirectory(prefix="gw-remesh-") as folder:
        source, result_file = Path(folder) / "given.npz", Path(folder) / "made.npz"
        np.savez(source, vertices=mesh.vertices.astype(np.float64), faces=mesh.faces)
        command = [sys.executable, "-m", __name__, task, repr(float(amount)), str(source), str(result_file)]
        try:
            subprocess.run(
                command, timeout=time_limit, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            with np.load(result_file, allow_pickle=False) as arrays:
                vertices, faces = arrays["vertices"], arrays["faces"]
        except (subprocess.SubprocessError, OSError, ValueError, KeyError):
            return None
    usable = len(faces) > 0 and np.isfinite(vertices).all() and faces.max() < len(vertices)
    return (vertices, faces) if usable else None


def _with_libigl(mesh: Mesh, target_faces: int) -> tuple[Doubles, NDArray]:
    """Edge collapse of the largest part; the mesh as it is where it cannot be collapsed."""
    import igl

    part = components(mesh.faces, len(mesh.vertices))
    largest = np.bincount(part[mesh.faces[:, 0]]).argmax()
    faces, rows = keep_faces(mesh.faces, part[mesh.faces[:, 0]] == largest, len(mesh.vertices))
    vertices = mesh.vertices[rows].astype(np.float64)
    if len(faces) <= target_faces:
        return vertices, faces
    less, fewer, _, _ = igl.decimate(np.asfortranarray(vertices), np.asfortranarray(faces), target_faces)
    return (less, fewer) if len(fewer) else (vertices, faces)


def _carry_over(mesh: Mesh, vertices: Doubles, faces: NDArray) -> Mesh:
    """The new mesh with colours and labels of the nearest old vertex."""
    if mesh.colors is None and mesh.labels is None:
        return Mesh(vertices.astype(np.float32), faces)
    from scipy.spatial import cKDTree

    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    colors = None if mesh.colors is None else mesh.colors[nearest]
    labels = None if mesh.labels is None else mesh.labels[nearest]
    return Mesh(vertices.astype(np.float32), faces, colors, labels)


def _area(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 2)


def _child(task: str, amount: str, source: str, result_file: str) -> None:
    """What the child does."""
    import pymeshlab

    with np.load(source, allow_pickle=False) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    work = pymeshlab.MeshSet()
    work.add_mesh(pymeshlab.Mesh(vertices, faces))
    work.meshing_remove_duplicate_vertices()
    work.meshing_remove_duplicate_faces()
    work.meshing_remove_null_faces()
    work.meshing_repair_non_manifold_edges()
    work.meshing_repair_non_manifold_vertices()
    if task.startswith("remesh"):
        if task == "remesh":
            work.meshing_close_holes(maxholesize=_MOST_HOLE_EDGES)
        work.meshing_isotropic_explicit_remeshing(iterations=4, targetlen=pymeshlab.PureValue(float(amount)))
    else:
        work.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int(float(amount)), preservenormal=True, preservetopology=True
        )
    work.meshing_remove_unreferenced_vertices()
    result = work.current_mesh()
    np.savez(result_file, vertices=result.vertex_matrix(), faces=result.face_matrix().astype(np.int32))


if __name__ == "__main__":
    _child(*sys.argv[1:])

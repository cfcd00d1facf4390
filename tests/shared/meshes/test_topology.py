from __future__ import annotations

import numpy as np
import trimesh

from stages.shared.meshes import (
    adjacency,
    boundary_edges,
    components,
    edges,
    face_normals,
    keep_faces,
    vertex_normals,
)

BALL = trimesh.creation.icosphere(subdivisions=3)


def test_normals_of_a_ball() -> None:
    normals = vertex_normals(BALL.vertices, BALL.faces)
    assert np.abs(normals - BALL.vertices).max() < 0.015
    faces, areas = face_normals(BALL.vertices, BALL.faces)
    np.testing.assert_allclose(faces, BALL.face_normals, atol=1e-9)
    np.testing.assert_allclose(areas, BALL.area_faces)


def test_degenerate_faces_and_lone_vertices_have_no_normal() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5.0]])
    normals = vertex_normals(vertices, np.array([[0, 1, 2]]))
    assert not normals.any()


def test_edges_and_neighbours() -> None:
    found = edges(BALL.faces)
    assert len(found) == len(BALL.edges_unique)
    assert len(BALL.vertices) - len(found) + len(BALL.faces) == 2  # Euler
    graph = adjacency(BALL.faces, len(BALL.vertices))
    assert graph.nnz == 2 * len(found) and (graph != graph.T).nnz == 0
    degree = np.asarray(graph.sum(axis=1)).ravel()
    assert sorted(set(degree.astype(int))) == [5, 6]


def test_boundary_runs_around_the_hole_in_the_direction_of_its_faces() -> None:
    keep = BALL.triangles_center[:, 1] < 0.5
    faces, used = keep_faces(BALL.faces, keep, len(BALL.vertices))
    assert len(boundary_edges(BALL.faces)) == 0
    rim = boundary_edges(faces)
    assert sorted(rim[:, 0]) == sorted(rim[:, 1]) and len(set(rim[:, 0])) == len(rim)
    np.testing.assert_array_equal(used[faces], BALL.faces[keep])
    directed = {tuple(edge) for face in faces for edge in (face[[0, 1]], face[[1, 2]], face[[2, 0]])}
    assert all(tuple(edge) in directed for edge in rim)


def test_components() -> None:
    two = trimesh.util.concatenate([BALL, trimesh.creation.box()])
    parts = components(two.faces, len(two.vertices))
    assert len(set(parts)) == 2
    assert len(set(parts[: len(BALL.vertices)])) == 1

"""Surface nets against a sphere, whose every property is known."""

from __future__ import annotations

import numpy as np

from stages.shared.meshes import boundary_edges, edges
from stages.synth.offset_surface import surface_nets

SPACING, RADIUS = 0.05, 0.33


def _sphere() -> tuple[np.ndarray, np.ndarray]:
    axis = np.arange(-0.5, 0.5 + SPACING / 2, SPACING)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return surface_nets(np.linalg.norm(nodes, axis=-1) - RADIUS, np.full(3, -0.5), SPACING)


def test_vertices_lie_on_the_surface() -> None:
    vertices, _ = _sphere()
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.1 * SPACING


def test_the_surface_is_closed_and_of_genus_zero() -> None:
    vertices, faces = _sphere()
    assert len(boundary_edges(faces)) == 0
    assert len(vertices) - len(edges(faces)) + len(faces) == 2


def test_normals_point_outwards() -> None:
    vertices, faces = _sphere()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fk,fk->f", normals, corners.mean(axis=1)) > 0).all()


def test_enclosed_volume_is_that_of_the_sphere() -> None:
    vertices, faces = _sphere()
    volume = np.linalg.det(vertices[faces]).sum() / 6
    assert abs(volume / (4 / 3 * np.pi * RADIUS**3) - 1) < 0.03

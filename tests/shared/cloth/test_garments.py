"""Meshes, riding points and materials."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared.cloth.constraints import build_constraints
from stages.shared.cloth.material import FLARED, Material
from stages.shared.cloth.remeshing import collapse_short_edges, simulation_mesh
from stages.shared.cloth.riding import averaging, ridden, ride
from stages.shared.cloth.surface import template_margins
from stages.shared.errors import BadData
from stages.shared.meshes import boundary_edges, edges
from tests.shared.cloth.sheets import grid, sphere


def test_points_ride_with_any_rigid_motion_of_the_mesh() -> None:
    draw = np.random.default_rng(5)
    vertices, faces = sphere(0.3)
    points = draw.normal(size=(50, 3))
    points *= (0.31 / np.linalg.norm(points, axis=1))[:, None]
    riding = ride(points, vertices, faces)
    still, frames = ridden(riding, vertices, faces)
    np.testing.assert_allclose(still, points, atol=1e-6)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved, turned = ridden(riding, vertices @ turn.T + [1.0, 2.0, 3.0], faces)
    np.testing.assert_allclose(moved, points @ turn.T + [1.0, 2.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(turned, turn @ frames, atol=1e-6)


def test_averages_of_a_constant_are_the_constant() -> None:
    vertices, faces = grid(4, 4, 0.05)
    points = np.random.default_rng(6).uniform(0, 0.15, (200, 3)) * [1, 0, 1]
    matrix = averaging(ride(points, vertices, faces), faces, len(vertices))
    np.testing.assert_allclose(matrix @ np.ones(200), 1.0)


def test_simulation_meshes_keep_openings_and_have_no_slivers() -> None:
    import trimesh

    tube = trimesh.creation.cylinder(radius=0.12, height=0.5, sections=40)
    wall = tube.subdivide_to_size(0.02)
    side = np.abs(wall.triangles_center[:, 2]) < 0.2499
    vertices, faces = simulation_mesh(np.array(wall.vertices), np.array(wall.faces)[side], 0.035)
    lengths = np.linalg.norm(vertices[edges(faces)[:, 0]] - vertices[edges(faces)[:, 1]], axis=1)
    assert lengths.min() > 0.2 * 0.035 and lengths.max() < 2.5 * 0.035
    rim = vertices[np.unique(boundary_edges(faces))]
    assert (np.abs(np.abs(rim[:, 2]) - 0.25) < 0.02).all() and len(rim) > 20


def test_short_edges_are_collapsed_and_the_rest_stays() -> None:
    vertices, faces = grid(5, 5, 0.05)
    vertices[12] = vertices[7] + [0.004, 0.0, 0.0]
    _, left = collapse_short_edges(vertices, faces, 0.02)
    assert len(left) == len(faces) - 2 and len(np.unique(left)) == 24
    assert len(boundary_edges(left)) == len(boundary_edges(faces))


def test_margins_are_at_most_the_distance_in_the_template() -> None:
    ball, faces = sphere(0.3, rings=40)
    points = np.array([[0.0, 0.35, 0.0], [0.0, 0.304, 0.0], [0.0, 0.29, 0.0]])
    margins = template_margins(points, ball, faces, 0.008, -0.05)
    np.testing.assert_allclose(margins, [0.008, 0.004, -0.01], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"density": -1.0}, "density"), ({"drag": "much"}, "drag"), ({"balanced": 1}, "balanced")],
)
def test_materials_that_no_cloth_has_are_refused(change: dict[str, object], word: str) -> None:
    assert Material.from_json(FLARED.to_json(), "here") == FLARED
    with pytest.raises(BadData, match=word):
        Material.from_json({**FLARED.to_json(), **change}, "here")
    with pytest.raises(BadData, match="material"):
        Material.from_json({"density": 0.2}, "here")


def test_meshes_that_cannot_be_simulated_are_refused() -> None:
    vertices, faces = grid(3, 3, 0.05)
    pins = np.zeros(9, bool)
    flat = vertices.copy()
    flat[4] = flat[0]
    flat[1] = flat[0]
    with pytest.raises(BadData, match="no area"):
        build_constraints(flat, faces, pins, FLARED)
    with pytest.raises(BadData, match=r"vertices\[2\]\[1\]"):
        build_constraints(np.where(np.arange(27).reshape(9, 3) == 7, np.nan, vertices), faces, pins, FLARED)
    with pytest.raises(BadData, match="do not exist"):
        build_constraints(vertices, faces + 5, pins, FLARED)

"""The cloth step against mechanics that is known: free fall, a hanging sheet, a sheet on a ball."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.synth import cloth
from stages.synth.collision import Collider, _closest, push_out

SECONDS = 1 / 600


def _sheet(count: int, size: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    axis = np.linspace(-size / 2, size / 2, count)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, np.full_like(x, height), z], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + count], axis=1)
    two = np.stack([corner + 1, corner + count + 1, corner + count], axis=1)
    return vertices, np.concatenate([one, two])


def test_a_free_vertex_falls_as_newton_says() -> None:
    positions, previous, velocities = np.zeros((1, 3)), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])
    for _ in range(300):
        cloth.predict(positions, previous, velocities, SECONDS, 0.0)
        cloth.update_velocities(positions, previous, velocities, SECONDS)
    assert positions[0] == pytest.approx([0.5, -0.5 * 9.81 * 0.25, 0.0], abs=0.01)


def test_a_hanging_sheet_does_not_stretch_and_comes_to_rest() -> None:
    vertices, faces = _sheet(12, 0.4, 1.0)
    model = cloth.cloth_model(vertices, faces)
    positions, previous, velocities = vertices.copy(), vertices.copy(), np.zeros_like(vertices)
    pinned = np.where(np.arange(len(vertices)) < 12, 1.0, 0.0)
    for _ in range(3000):
        cloth.predict(positions, previous, velocities, SECONDS, model.drag)
        cloth.solve_distances(positions, model.wings, model.wing_lengths, model.bend_compliance, SECONDS, 1)
        cloth.solve_distances(positions, model.edges, model.rest_lengths, 0.0, SECONDS, 2)
        cloth.hold_pins(positions, vertices, pinned, SECONDS)
        cloth.update_velocities(positions, previous, velocities, SECONDS)
        cloth.damp_distances(positions, velocities, model.edges, 0.5)
    assert np.abs(cloth.stretch_of(model, positions) - 1).max() < 0.06
    assert positions[:, 1].min() == pytest.approx(1.0 - 0.4, abs=0.03)
    assert np.abs(velocities).max() < 0.1


def test_a_sheet_dropped_on_a_ball_stays_outside() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.15)
    surface = np.ascontiguousarray(ball.vertices)
    collider = Collider(np.asarray(ball.faces, np.int64), np.ones(len(surface), bool), True, 0.5)
    normals = np.zeros_like(surface)
    cloth.area_normals(surface, collider.faces, normals)
    positions, faces = _sheet(21, 0.4, 0.17)
    model = cloth.cloth_model(positions, faces)
    previous, velocities = positions.copy(), np.zeros_like(positions)
    for step in range(600):
        if step % 20 == 0:
            nearest = collider.nearest(collider.tree(surface), positions)
        cloth.predict(positions, previous, velocities, SECONDS, model.drag)
        cloth.solve_distances(positions, model.edges, model.rest_lengths, 0.0, SECONDS, 2)
        push_out(
            positions, previous, nearest, surface, surface, normals, collider.faces, collider.first,
            collider.incident, collider.border, 0.005, collider.friction, True,
        )  # fmt: skip
        cloth.update_velocities(positions, previous, velocities, SECONDS)
    distance = np.linalg.norm(positions, axis=1)
    assert distance.min() > 0.15
    assert (np.abs(distance - 0.155) < 0.004).sum() > 100  # it drapes, it has not bounced off
    assert positions[:, 1].min() < 0.0


def test_closest_point_agrees_with_trimesh() -> None:
    random = np.random.default_rng(3)
    triangles = random.normal(size=(400, 3, 3))
    points = random.normal(size=(400, 3)) * 1.5
    expected = trimesh.triangles.closest_point(triangles, points)
    weights, face = np.zeros(3), np.array([0, 1, 2])
    for triangle, point, closest in zip(triangles, points, expected, strict=True):
        squared = _closest(point, triangle, face, weights)
        assert weights @ triangle == pytest.approx(closest, abs=1e-9)
        assert squared == pytest.approx(((point - closest) ** 2).sum(), abs=1e-9)

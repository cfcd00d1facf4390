"""Distances to a true mesh: cases that can be counted by hand, and trimesh as the oracle."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.shared.metrics.vertex_error import (
    bind,
    material_distances,
    spanned_triangles,
    statistics,
    surface_distances,
)

CM = np.float32(0.01)


def sheet(rows: int = 12, columns: int = 9, pitch: float = 0.02) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat sheet at z = 0: points (N, 3), triangles (M, 3), neighbours (N, 4)."""
    number = np.arange(rows * columns).reshape(rows, columns)
    padded = np.pad(number, 1, constant_values=-1)
    neighbours = np.stack(
        [padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2]], axis=-1
    ).reshape(-1, 4)
    row, column = np.divmod(np.arange(rows * columns), columns)
    points = np.stack([pitch * column, -pitch * row, 0 * row], axis=1).astype(np.float32)
    return points, spanned_triangles(neighbours), neighbours


def bent(points: np.ndarray) -> np.ndarray:
    """The sheet as a wave."""
    return points + np.stack([0 * points[:, 0], 0 * points[:, 0], 0.03 * np.sin(40 * points[:, 0])], 1)


def inner(points: np.ndarray) -> np.ndarray:
    """(N,) which points are more than 3 cm from the rim of the flat sheet."""
    low, high = points[:, :2].min(axis=0) + 0.03, points[:, :2].max(axis=0) - 0.03
    return ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)


def test_triangles_between_texels_cover_the_sheet_once() -> None:
    points, triangles, _ = sheet(5, 4)
    assert len(triangles) == 2 * 4 * 3 and len({tuple(sorted(t)) for t in triangles.tolist()}) == 24
    assert trimesh.Trimesh(points, triangles, process=False).area == pytest.approx(4 * 3 * 0.02**2, rel=1e-5)
    assert spanned_triangles(np.full((3, 4), -1)).shape == (0, 3)


@pytest.mark.parametrize("axis", [0, 2])
def test_cloth_that_slides_is_on_the_surface_and_in_the_wrong_place(axis: int) -> None:
    """1 cm along the sheet: surfaces agree, points of the cloth are 1 cm off; across it: both see it."""
    points, triangles, _ = sheet()
    shift = CM * np.eye(3, dtype=np.float32)[axis]
    binding = bind(points, points, triangles, 0.02)
    assert binding.bound.all()
    there, back = surface_distances(points + shift, triangles, points, triangles)
    material = material_distances(binding, points + shift, points)
    np.testing.assert_allclose(material, CM, atol=1e-6)
    expected = 0.0 if axis == 0 else CM
    np.testing.assert_allclose(there[inner(points)], expected, atol=1e-6)
    np.testing.assert_allclose(back[inner(points)], expected, atol=1e-6)


def test_a_point_of_the_cloth_is_found_again_wherever_the_cloth_goes() -> None:
    points, triangles, _ = sheet()
    between = points[triangles[:40]].mean(axis=1)
    binding = bind(between, points, triangles, 0.001)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    moved = (bent(points) @ turn.T + [1, 2, 3]).astype(np.float32)
    followed = moved[triangles[:40]].mean(axis=1)
    assert material_distances(binding, followed, moved).max() < 1e-5
    assert material_distances(binding, between, moved).min() > 1


def test_points_far_from_the_true_template_are_no_points_of_the_cloth() -> None:
    points, triangles, _ = sheet()
    lifted = points.copy()
    lifted[::2, 2] += 0.03
    binding = bind(lifted, points, triangles, 0.02)
    assert not binding.bound[::2].any() and binding.bound[1::2].all()
    assert len(material_distances(binding, lifted, points)) == len(points) // 2
    assert material_distances(binding, lifted, points).max() < 1e-6


def test_distances_are_those_of_trimesh() -> None:
    points, triangles, _ = sheet()
    random = np.random.default_rng(0)
    truth = bent(points).astype(np.float32)
    cloud = (points + random.normal(0, 0.02, points.shape)).astype(np.float32)
    there, back = surface_distances(cloud, triangles, truth, triangles)
    closest, ours = trimesh.proximity.closest_point_naive, trimesh.Trimesh(truth, triangles, process=False)
    np.testing.assert_allclose(there, closest(ours, cloud)[1], atol=2e-6)
    learned = trimesh.Trimesh(cloud, triangles, process=False)
    np.testing.assert_allclose(back, closest(learned, truth)[1], atol=2e-6)
    _, alone = surface_distances(cloud, triangles[:0], truth, triangles)
    expected = np.linalg.norm(truth[:, None] - cloud[None], axis=2).min(axis=1)
    np.testing.assert_allclose(alone, expected, atol=1e-6)
    assert (alone >= back - 1e-7).all() and (alone > back + 1e-4).any()


def test_statistics() -> None:
    assert statistics(np.arange(101) / 100) == {"mean": 0.5, "median": 0.5, "p95": 0.95}
    assert statistics(np.zeros(0)) == {"mean": None, "median": None, "p95": None}

"""Voxel fields: sampling, bands, diffusion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from stages.shared.fields.diffusion import (
    average_neighbours,
    band_laplacian,
    conjugate_gradient,
    diffuse_by_distance,
    inverse_distance_matrix,
)
from stages.shared.fields.voxel_field import VoxelField, nearest_rows, node_positions

CENTRE = np.array([0.2, -0.1, 0.5])
HALF = np.array([1.0, 0.7, 0.3])


def random_field(seed: int = 0, shape: tuple[int, int, int] = (5, 6, 7), channels: int = 4) -> VoxelField:
    values = np.random.default_rng(seed).normal(size=(channels, *shape)).astype(np.float32)
    return VoxelField.from_band(values.reshape(channels, -1).T, np.ones(shape, bool), CENTRE, HALF)


def test_nodes_have_their_own_values() -> None:
    field = random_field()
    nodes = node_positions(field.rows.shape, CENTRE, HALF).reshape(-1, 3)
    np.testing.assert_allclose(field.sample(nodes), field.dense.reshape(4, -1).T, atol=1e-6)


def test_sampling_equals_scipy_inside_the_box() -> None:
    field = random_field(1)
    points = CENTRE + HALF * np.random.default_rng(2).uniform(-1, 1, size=(500, 3))
    axes = [np.linspace(c - e, c + e, n) for c, e, n in zip(CENTRE, HALF, (7, 6, 5), strict=True)]
    oracle = RegularGridInterpolator(axes[::-1], np.moveaxis(field.dense, 0, -1))
    np.testing.assert_allclose(field.sample(points), oracle(points[:, ::-1]), atol=1e-6)


def test_outside_the_box_the_border_is_read() -> None:
    field = random_field(3)
    far = CENTRE + np.array([[5.0, 0.1, -0.1], [0.2, -9.0, 0.0], [3.0, 3.0, 3.0]])
    on_border = np.clip(far, CENTRE - HALF, CENTRE + HALF)
    np.testing.assert_allclose(field.sample(far), field.sample(on_border), atol=1e-12)


def test_constant_field_is_constant_everywhere() -> None:
    band = np.zeros((6, 6, 6), dtype=bool)
    band[2:4, 2:5, 1:3] = True
    field = VoxelField.from_band(np.full((band.sum(), 2), 0.25), band, CENTRE, HALF)
    points = np.random.default_rng(4).normal(scale=3.0, size=(200, 3))
    np.testing.assert_allclose(field.sample(points), 0.25, atol=1e-7)


def test_nodes_off_the_band_borrow_the_nearest_node() -> None:
    band = np.random.default_rng(5).random((4, 5, 6)) < 0.2
    inside = np.argwhere(band)
    distances = np.linalg.norm(np.argwhere(np.ones_like(band))[:, None] - inside[None], axis=2)
    borrowed = distances[np.arange(band.size), nearest_rows(band).ravel()]
    np.testing.assert_allclose(borrowed, distances.min(axis=1))


def test_arrays_round_trip() -> None:
    field = random_field(6)
    again = VoxelField.from_arrays(field.to_arrays("weights"), "weights")
    points = np.random.default_rng(7).normal(size=(50, 3))
    np.testing.assert_allclose(again.sample(points), field.sample(points), atol=1e-6)


def test_inverse_distance_equals_plain_loops() -> None:
    generator = np.random.default_rng(8)
    vertices, points = generator.normal(size=(40, 3)), generator.normal(size=(9, 3))
    values = generator.normal(size=(40, 2))
    matrix, distance, nearest = inverse_distance_matrix(cKDTree(vertices), points, neighbours=5, clamp=1e-4)
    for row, point in enumerate(points):
        distances = np.linalg.norm(vertices - point, axis=1)
        chosen = np.argsort(distances)[:5]
        weight = 1 / np.maximum(distances[chosen], 1e-4)
        expected = (weight[:, None] * values[chosen]).sum(axis=0) / weight.sum()
        np.testing.assert_allclose(matrix[row] @ values, expected[None], rtol=1e-9)
        assert nearest[row] == chosen[0]
        assert distance[row] == pytest.approx(distances.min())


def test_averaging_keeps_constants_and_border_and_flattens_a_spike() -> None:
    values = np.zeros((1, 5, 5, 5))
    values[0, 2, 2, 2] = 1.0
    once = average_neighbours(values, iterations=1)
    assert once[0, 2, 2, 2] == pytest.approx(0.7)
    assert once[0, 1, 2, 2] == pytest.approx(0.05)
    np.testing.assert_allclose(average_neighbours(np.ones((2, 4, 4, 4)), 7), 1.0)
    ramp = np.broadcast_to(np.arange(6.0), (1, 6, 6, 6))
    np.testing.assert_allclose(average_neighbours(ramp, 9), ramp)


def test_conjugate_gradient_equals_a_direct_solver() -> None:
    band = np.random.default_rng(9).random((6, 6, 6)) < 0.6
    count = int(band.sum())
    keep = np.random.default_rng(10).uniform(0.1, 50.0, count)
    matrix = (band_laplacian(band, np.array([0.5, 0.4, 0.3])) + sparse.diags(keep)).tocsr()
    right = np.random.default_rng(11).normal(size=(count, 3))
    found = conjugate_gradient(matrix, right, np.zeros_like(right), tolerance=1e-10)
    np.testing.assert_allclose(found, spsolve(matrix.tocsc(), right), atol=1e-7)


def test_wide_spread_keeps_weights_convex_and_is_mirror_symmetric() -> None:
    band = np.ones((3, 5, 11), dtype=bool)
    left = np.zeros((3, 5, 11))
    left[..., :5] = 1.0
    left[..., 5] = 0.5
    values = np.stack([left.ravel(), 1.0 - left.ravel()], axis=1)
    lengths = np.full(band.size, 0.3)
    spread = diffuse_by_distance(values, lengths, band, np.array([0.1, 0.1, 0.1]), tolerance=1e-7)
    np.testing.assert_allclose(spread.sum(axis=1), 1.0, atol=1e-5)
    assert spread.min() > 0 and spread.max() < 1
    grid = spread[:, 0].reshape(band.shape)
    np.testing.assert_allclose(grid, 1.0 - grid[..., ::-1], atol=1e-5)
    steps = np.diff(grid[1, 2])
    assert np.abs(steps).max() < 0.25, "the jump of 1 over one cell has become a slope"
    short = diffuse_by_distance(values, np.full(band.size, 1e-3), band, np.array([0.1, 0.1, 0.1]))
    np.testing.assert_allclose(short, values, atol=1e-3)

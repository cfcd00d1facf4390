"""Cloth inside the body is led out along its normal; cloth outside, and cloth far away, is left alone."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.avatar.deform import PosedGaussians
from stages.train.tracking.normal_equations import collision_equations


def _ball(count: int = 4000, radius: float = 0.2) -> PosedGaussians:
    """A body that is a ball."""
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    y = 1 - 2 * (np.arange(count) + 0.5) / count
    across = np.sqrt(1 - y * y)
    normals = torch.from_numpy(np.stack((across * np.cos(turn), y, across * np.sin(turn)), axis=1)).float()
    zeros = torch.zeros(count, 3)
    return PosedGaussians(
        radius * normals, torch.zeros(count, 3, 3), torch.ones(count), zeros, normals, zeros
    )


def test_solving_brings_texels_to_the_clearance_above_the_body() -> None:
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth = generator.uniform(0.005, 0.02, 50)
    points = directions * (0.2 - depth)[:, None]
    turned = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    carried = np.tile(turned, (50, 1, 1))
    matrix, right = collision_equations(torch.from_numpy(points).float(), _ball(), carried, 220.0)
    change = (
        np.stack([np.linalg.lstsq(m, r, rcond=None)[0] for m, r in zip(matrix, right, strict=True)]) / 220.0
    )
    moved = points + change @ turned.T
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.204, atol=5e-4)
    sideways = np.cross(moved, directions)
    assert np.abs(sideways).max() < 2e-3


def test_what_is_outside_or_far_inside_is_free() -> None:
    points = torch.tensor([[0.0, 0.21, 0.0], [0.0, 0.5, 0.0], [0.0, 0.1, 0.0]])
    matrix, right = collision_equations(points, _ball(), np.tile(np.eye(3), (3, 1, 1)), 220.0)
    assert not matrix.any() and not right.any()

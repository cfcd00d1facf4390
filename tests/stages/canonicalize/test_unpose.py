"""Inverse skinning: exact with kept weights, consistent with the field where the root is found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.canonicalize.unpose import forward_skin, inverse_skin, unpose
from stages.shared.body.canonical import canonical_from_rest, posed_from_canonical
from stages.shared.body.kinematics import posed_vertices, shaped_vertices, skin
from stages.shared.body.load import embedded_body
from stages.shared.body.model import BodyModel

CASES = [(0, 0.0, 0.0), (1, 1.0, 0.25), (2, 2.5, 0.4), (3, -2.0, 0.6)]  # seed, shape, bend in radians


def subject(seed: int, shape: float, bend: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rotations (55, 3), translation (3,), betas (10,) of a random pose."""
    generator = torch.Generator().manual_seed(seed)
    rotations = bend * torch.randn(55, 3, generator=generator, dtype=torch.float64)
    rotations[0] *= 4
    translation = torch.randn(3, generator=generator, dtype=torch.float64)
    return rotations, translation, shape * torch.randn(10, generator=generator, dtype=torch.float64)


def canonical(body: BodyModel, betas: torch.Tensor) -> np.ndarray:
    weights = torch.as_tensor(body.skin_weights, dtype=torch.float64)
    return skin(shaped_vertices(body, betas), weights, canonical_from_rest(body, betas)).numpy()


@pytest.mark.parametrize(("seed", "shape", "bend"), CASES)
def test_a_skinned_body_returns_to_its_canonical_vertices(seed: int, shape: float, bend: float) -> None:
    body = embedded_body()
    rotations, translation, betas = subject(seed, shape, bend)
    transforms = posed_from_canonical(body, rotations, translation, betas)
    weights = torch.as_tensor(body.skin_weights, dtype=torch.float64)
    world = skin(torch.from_numpy(canonical(body, betas)), weights, transforms).numpy()
    points, replaced = inverse_skin(world, weights.numpy(), transforms.numpy())
    error = np.linalg.norm(points - canonical(body, betas), axis=1)
    assert error[~replaced].max() < 1e-6
    assert replaced.mean() < 0.02


@pytest.mark.parametrize(("seed", "shape", "bend"), CASES)
def test_rigid_parts_return_from_the_posed_body(seed: int, shape: float, bend: float) -> None:
    body = embedded_body()
    rotations, translation, betas = subject(seed, shape, bend)
    world = posed_vertices(body, rotations, translation, betas).numpy()
    transforms = posed_from_canonical(body, rotations, translation, betas).numpy()
    points, _ = inverse_skin(world, body.skin_weights.astype(np.float64), transforms)
    rigid = body.skin_weights.max(axis=1) > 0.9999
    assert rigid.mean() > 0.2
    np.testing.assert_allclose(points[rigid], canonical(body, betas)[rigid], atol=2e-3)


@pytest.mark.parametrize(("seed", "shape", "bend"), CASES)
def test_kept_weights_pose_back_exactly(seed: int, shape: float, bend: float) -> None:
    body = embedded_body()
    rotations, translation, betas = subject(seed, shape, bend)
    transforms = posed_from_canonical(body, rotations, translation, betas).numpy()
    generator = np.random.default_rng(seed)
    weights = generator.dirichlet(np.full(4, 0.7), size=500)
    full = np.zeros((500, 55))
    joints = generator.integers(0, 22, size=(500, 4))
    np.add.at(full, (np.arange(500)[:, None], joints), weights)
    world = generator.normal(size=(500, 3))
    points, replaced = inverse_skin(world, full, transforms)
    back = forward_skin(points, full, transforms)
    np.testing.assert_allclose(back[~replaced], world[~replaced], atol=1e-9)


def smooth_weights(points: np.ndarray) -> np.ndarray:
    """Two bones that hand over along x within 20 cm."""
    share = 1 / (1 + np.exp(-points[:, 0] / 0.05))
    return np.stack([1 - share, share], axis=1)


def two_bones(angle: float) -> np.ndarray:
    transforms = np.stack([np.eye(4), np.eye(4)])
    c, s = np.cos(angle), np.sin(angle)
    transforms[1, :3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    return transforms


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2, -1.2])
def test_root_agrees_with_the_field(angle: float) -> None:
    true = np.random.default_rng(1).uniform([-0.5, -0.1, -0.1], [0.5, 0.1, 0.1], size=(300, 3))
    transforms = two_bones(angle)
    world = forward_skin(true, smooth_weights(true), transforms)
    start = np.clip(smooth_weights(true) + np.random.default_rng(2).normal(scale=0.1, size=(300, 2)), 0, None)
    start /= start.sum(axis=1, keepdims=True)
    found = unpose(world, start, transforms, smooth_weights)
    assert found.residual.max() < 1e-9
    assert np.percentile(found.requeried_residual, 95) < 1e-6
    np.testing.assert_allclose(found.weights, smooth_weights(found.points), atol=1e-4)
    assert np.percentile(np.linalg.norm(found.points - true, axis=1), 95) < 1e-4


def test_nearly_singular_blends_fall_back_and_stay_finite() -> None:
    transforms = two_bones(np.pi)
    world = np.random.default_rng(3).normal(size=(20, 3))
    weights = np.full((20, 2), 0.5)
    points, replaced = inverse_skin(world, weights, transforms)
    assert replaced.all() and np.isfinite(points).all()
    expected = 0.5 * world + 0.5 * (world @ transforms[1, :3, :3])
    np.testing.assert_allclose(points, expected, atol=1e-12)
    found = unpose(world, weights, transforms, lambda points: np.full((len(points), 2), 0.5))
    assert found.blended_inverse == 20 and np.isfinite(found.points).all()

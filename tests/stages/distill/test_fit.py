"""Distillation: components against numpy's own decomposition, and a teacher whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.distill.config import DistillConfig
from stages.distill.fit import Samples, blend_rotations, components, fit_layer
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.blendshapes import BlendshapeDecoder, BlendshapeSizes
from stages.shared.avatar.decoders.texel_attributes import BASIS_GROUPS, group_channels
from stages.shared.quaternions import matrices_from_quaternions
from tests.shared.avatar.tubes import tube


def _pose(first: float, second: float) -> torch.Tensor:
    transforms = torch.eye(4).repeat(55, 1, 1)
    for joint, angle in ((3, first), (16, second)):
        half = torch.tensor([angle / 2])
        quaternion = torch.stack((half.cos(), half.sin(), half * 0, half * 0), 1)
        transforms[joint, :3, :3] = matrices_from_quaternions(quaternion)[0]
    return transforms


def _teacher(centres: int = 3) -> BlendshapeDecoder:
    """Itself of blendshapes, so that a perfect pupil exists; smooth in the pose."""
    config = ModelConfig(decoder="blendshapes")
    model = BlendshapeDecoder(tube(), config, BlendshapeSizes(2, 2, 1, centres))
    model.fit_input([_pose(0.4 * k, -0.3 * k) for k in range(centres)])
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        model.coefficients.bandwidth.fill_(2.0)
        for group in BASIS_GROUPS:
            basis = getattr(model, f"basis_{group}")
            basis.copy_(torch.randn(basis.shape, generator=generator))
    return model


POSES = [_pose(0.08 * a, -0.1 * b) for a in range(8) for b in range(5)]


def _samples(poses: list[torch.Tensor]) -> Samples:
    return Samples(poses, [], len(poses))


@pytest.mark.parametrize("most", [1, 3, 9])
def test_components_are_the_singular_vectors(most: int) -> None:
    values = torch.randn(10, 50, 3, generator=torch.Generator().manual_seed(0))
    values -= values.mean(dim=0)
    found = components(values, unit=1.0, tolerance=0.0, most=most)
    _, spread, axes = np.linalg.svd(values.reshape(10, -1).double().numpy(), full_matrices=False)
    rebuilt = torch.einsum("tk,nck->tnc", found.scores, found.bases)
    best = values.reshape(10, -1).double().numpy() @ axes[:most].T @ axes[:most]
    np.testing.assert_allclose(rebuilt.reshape(10, -1), best, atol=1e-4)
    assert found.energy == pytest.approx((spread[:most] ** 2).sum() / (spread**2).sum(), abs=1e-6)
    assert found.left_out == pytest.approx(np.sqrt((spread[most:] ** 2).sum() / (10 * 50)), abs=1e-5)


def test_as_few_components_as_the_tolerance_allows() -> None:
    generator = torch.Generator().manual_seed(1)
    strong = torch.linspace(-1, 1, 20)[:, None, None] * torch.randn(40, 3, generator=generator)
    values = strong + 1e-4 * torch.randn(20, 40, 3, generator=generator)
    assert components(values, 1.0, tolerance=0.01, most=8).scores.shape[1] == 1
    assert components(values, 1.0, tolerance=0.0, most=8).scores.shape[1] == 8


def test_nothing_moves_costs_one_empty_component() -> None:
    found = components(torch.zeros(5, 30, 3), 1.0, 0.001, 4)
    assert found.scores.shape[1] == 1 and found.energy == 1.0
    assert torch.equal(found.bases, torch.zeros(30, 3, 1))


def test_a_pupil_answers_as_its_teacher() -> None:
    teacher = _teacher()
    with torch.no_grad():
        residuals = torch.stack([teacher.residual(pose) for pose in POSES])
        config = DistillConfig(offset_tolerance=1e-5, color_tolerance=1e-4, form_tolerance=1e-4)
        pupil = fit_layer(teacher, residuals, _samples(POSES), config)
        unseen = _pose(0.21, -0.17)
        expected, found = teacher(unseen), pupil.model(unseen)
    spread = residuals.std(dim=0).mean()
    assert torch.allclose(found.offsets, expected.offsets, atol=5e-3 * float(spread))
    assert torch.allclose(found.colors, expected.colors, atol=5e-3)
    assert max(pupil.unseen_error.values()) < 0.05 * float(spread)
    for group in BASIS_GROUPS:
        assert pupil.components[group].scores.shape[1] <= 3, group
        assert len(group_channels(group)) == pupil.components[group].bases.shape[1]


def test_free_attributes_are_taken_over() -> None:
    teacher = _teacher()
    with torch.no_grad():
        teacher.base_offset.add_(0.01)
        residuals = torch.stack([teacher.residual(pose) for pose in POSES[:6]])
        pupil = fit_layer(teacher, residuals, _samples(POSES[:6]), DistillConfig()).model
    for name in ("offset", "quaternion", "opacity", "scale", "color"):
        assert torch.equal(getattr(pupil, f"base_{name}"), getattr(teacher, f"base_{name}")), name


def test_blended_rotations_lie_on_the_shortest_arc() -> None:
    one = torch.zeros(55, 3)
    other = torch.zeros(55, 3)
    other[5] = torch.tensor([0.0, 0.8, 0.0])
    half = blend_rotations(one, other, 0.5)
    assert torch.allclose(half[5], torch.tensor([0.0, 0.4, 0.0]), atol=1e-6)
    assert half.abs().sum() == pytest.approx(0.4, abs=1e-5)

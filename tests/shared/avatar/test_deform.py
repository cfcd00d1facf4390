"""Deformation against a loop over points and bones, written out with numpy."""

from __future__ import annotations

import numpy as np
import torch

from stages.shared.avatar.deform import Attributes, estimate_normals, pose_layer, view_cosines
from stages.shared.quaternions import matrices_from_quaternions, unit_quaternions
from tests.shared.avatar.tubes import tube


def _transforms(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    quaternions = torch.nn.functional.normalize(torch.randn(55, 4, generator=generator), dim=1)
    transforms = torch.eye(4).repeat(55, 1, 1)
    transforms[:, :3, :3] = matrices_from_quaternions(quaternions)
    transforms[:, :3, 3] = torch.randn(55, 3, generator=generator)
    return transforms


def test_pose_layer_equals_an_explicit_loop() -> None:
    maps = tube()
    generator = torch.Generator().manual_seed(3)
    count = len(maps)
    attributes = Attributes(
        offsets=torch.randn(count, 3, generator=generator) * 0.01,
        quaternions=unit_quaternions(torch.randn(count, 4, generator=generator)),
        scales=torch.rand(count, 3, generator=generator) * 0.01,
        opacities=torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
    )
    transforms, betas = _transforms(1), torch.randn(10, generator=generator)
    posed = pose_layer(maps, attributes, transforms, betas)
    for index in range(0, count, 37):
        point = maps.positions[index].double().numpy() + attributes.offsets[index].double().numpy()
        for b in range(10):
            point = point + float(betas[b]) * maps.shape_directions[index, b].double().numpy()
        mean, matrix = np.zeros(3), np.zeros((3, 3))
        for joint in range(55):
            weight = float(maps.skin_weights[index, joint])
            bone = transforms[joint].double().numpy()
            mean += weight * (bone[:3, :3] @ point + bone[:3, 3])
            matrix += weight * bone[:3, :3]
        w, v = float(attributes.quaternions[index, 0]), attributes.quaternions[index, 1:].double().numpy()
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        covariance = rotation @ np.diag(attributes.scales[index].double().numpy() ** 2) @ rotation.T
        np.testing.assert_allclose(posed.means[index].numpy(), mean, atol=2e-6)
        np.testing.assert_allclose(
            posed.covariances[index].numpy(), matrix @ covariance @ matrix.T, atol=1e-9
        )


def test_estimated_normals_are_the_tubes_own() -> None:
    maps = tube()
    normals = estimate_normals(maps.positions, maps, maps.normals)
    whole = (maps.neighbours >= 0).all(dim=1)
    cosine = (normals * maps.normals).sum(dim=1)[whole]
    assert cosine.min() > 0.95
    assert torch.allclose(normals.norm(dim=1), torch.ones(len(maps)), atol=1e-5)


def test_normals_without_neighbours_fall_back() -> None:
    maps = tube()
    collapsed = torch.zeros_like(maps.positions)
    normals = estimate_normals(collapsed, maps, maps.normals * 3)
    assert torch.allclose(normals, maps.normals, atol=1e-5)


def test_viewing_cosine_is_that_of_normal_and_direction() -> None:
    maps = tube()
    still = torch.eye(4).repeat(55, 1, 1)
    far = view_cosines(maps, still, torch.zeros(10), torch.tensor([0.0, 0.0, 1e5]))
    assert torch.allclose(far, maps.normals[:, 2], atol=1e-4)
    eye = torch.tensor([0.5, 0.2, 1.0])
    direction = torch.nn.functional.normalize(eye - maps.positions, dim=1)
    near = view_cosines(maps, still, torch.zeros(10), eye)
    assert torch.allclose(near, (direction * maps.normals).sum(dim=1), atol=1e-5)


def test_zero_quaternion_is_the_identity_and_has_a_finite_gradient() -> None:
    quaternions = torch.zeros(2, 4, requires_grad=True)
    unit = unit_quaternions(quaternions)
    unit.square().sum().backward()
    assert torch.equal(unit.detach(), torch.tensor([[1.0, 0, 0, 0]] * 2))
    assert torch.isfinite(quaternions.grad).all()

"""Forward kinematics and skinning against slow, plainly written code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.shared.body import (
    PARENTS,
    BodyModel,
    blend,
    bone_transforms,
    embedded_body,
    load_body,
    posed_joints,
    posed_vertices,
    rigid_inverse,
    rotation_matrices,
    shaped_joints,
    skin,
)
from tests.shared.conftest import VERTICES


def random_pose(seed: int, size: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (55, 3), translation (3,), betas (10,)."""
    random = np.random.default_rng(seed)
    return random.normal(0, size, (55, 3)), random.normal(0, 1, 3), random.normal(0, 1, 10)


def slow_bones(rotations: np.ndarray, joints: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """posed_from_rest (55, 4, 4), one joint after the other."""
    world: list[np.ndarray] = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(rotations[joint]).as_matrix()
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
    result = []
    for joint in range(55):
        back = np.eye(4)
        back[:3, 3] = -joints[joint]
        moved = world[joint] @ back
        moved[:3, 3] += translation
        result.append(moved)
    return np.stack(result)


def slow_vertices(
    arrays: dict[str, np.ndarray], pose: tuple[np.ndarray, ...], expression: np.ndarray
) -> np.ndarray:
    """The whole body model out of the arrays of its file, vertex by vertex."""
    rotations, translation, betas = pose
    shaped = arrays["v_template"] + arrays["shapedirs"][:, :, :10] @ betas
    shaped = shaped + arrays["shapedirs"][:, :, 300:310] @ expression
    joints = arrays["J_regressor"] @ shaped
    feature = [Rotation.from_rotvec(r).as_matrix() - np.eye(3) for r in rotations[1:]]
    corrected = shaped + arrays["posedirs"] @ np.concatenate([m.reshape(-1) for m in feature])
    bones = slow_bones(rotations, joints, translation)
    result = np.zeros_like(corrected)
    for vertex in range(len(corrected)):
        point = np.append(corrected[vertex], 1.0)
        for joint in range(55):
            result[vertex] += arrays["weights"][vertex, joint] * (bones[joint] @ point)[:3]
    return result


@pytest.mark.parametrize(
    "rotation",
    [
        (0.0, 0.0, 0.0),
        (1e-9, 0.0, 0.0),
        (0.0, 3e-3, 1e-3),
        (0.0099, 0.0, 0.0),
        (0.0101, 0.0, 0.0),
        (0.3, -0.2, 0.9),
        (np.pi - 1e-7, 0.0, 0.0),
        (0.0, 2 * np.pi, 0.0),
        (40.0, -3.0, 7.0),
    ],
)
def test_rotation_matrices_agree_with_scipy(rotation: tuple[float, float, float]) -> None:
    wanted = Rotation.from_rotvec(rotation).as_matrix()
    double = rotation_matrices(torch.tensor(rotation, dtype=torch.float64)).numpy()
    single = rotation_matrices(torch.tensor(rotation, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(double, wanted, atol=3e-14)
    np.testing.assert_allclose(single, wanted, atol=2e-5)


def test_rotation_gradient_is_right_at_and_around_zero() -> None:
    for size in (0.0, 1e-12, 1e-4, 9.9e-3, 1.01e-2, 3.0):
        axis = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64) * size
        assert torch.autograd.gradcheck(rotation_matrices, axis.requires_grad_(), atol=1e-6)


def test_bones_agree_with_the_slow_chain_for_a_batch() -> None:
    poses = [random_pose(seed) for seed in range(4)]
    joints = np.random.default_rng(9).normal(0, 0.4, (55, 3))
    rotations = torch.from_numpy(np.stack([p[0] for p in poses])).reshape(2, 2, 55, 3)
    translation = torch.from_numpy(np.stack([p[1] for p in poses])).reshape(2, 2, 3)
    bones = bone_transforms(rotations, torch.from_numpy(joints), translation=translation).reshape(4, 55, 4, 4)
    for got, (rotation, moved, _) in zip(bones.numpy(), poses, strict=True):
        np.testing.assert_allclose(got, slow_bones(rotation, joints, moved), atol=1e-12)


def test_vertices_of_a_full_model_agree_with_slow_skinning(smplx_file: Path) -> None:
    body = load_body(smplx_file)
    with np.load(smplx_file, allow_pickle=False) as file:
        arrays = {
            name: file[name] for name in ("v_template", "shapedirs", "J_regressor", "weights", "posedirs")
        }
    pose, expression = random_pose(1), np.random.default_rng(2).normal(0, 1, 10)
    got = posed_vertices(body, *(torch.from_numpy(v) for v in pose), torch.from_numpy(expression))
    assert got.shape == (VERTICES, 3)
    np.testing.assert_allclose(got.numpy(), slow_vertices(arrays, pose, expression), atol=2e-6)
    without = posed_vertices(body, *(torch.from_numpy(v) for v in pose))
    assert float((got - without).abs().max()) > 1e-3  # the expression does something


def test_root_turns_about_the_pelvis_and_translation_adds() -> None:
    body = embedded_body()
    betas = torch.linspace(-1, 1, 10, dtype=torch.float64)
    rotations = torch.zeros(55, 3, dtype=torch.float64)
    rotations[0] = torch.tensor([0.3, 1.2, -0.4])
    translation = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    pelvis = shaped_joints(body, betas)[0]
    torch.testing.assert_close(posed_joints(body, rotations, translation, betas)[0], pelvis + translation)


def test_single_precision_is_close_to_double() -> None:
    body = embedded_body()
    pose = [torch.from_numpy(values) for values in random_pose(4)]
    double = posed_vertices(body, *pose)
    single = posed_vertices(body, *(values.float() for values in pose))
    assert float((double - single).abs().max()) < 2e-5


def test_gradients_reach_pose_shape_and_translation() -> None:
    body = embedded_body()
    values = [torch.zeros(55, 3), torch.zeros(3), torch.zeros(10)]
    leaves = [value.double().requires_grad_() for value in values]
    (posed_vertices(body, *leaves) ** 2).sum().backward()
    for leaf in leaves:
        assert torch.isfinite(leaf.grad).all()
        assert float(leaf.grad.abs().max()) > 0


def test_skin_is_blend_applied_and_inverse_undoes_bones() -> None:
    body = embedded_body()
    rotations, translation, betas = (torch.from_numpy(values) for values in random_pose(7))
    bones = bone_transforms(rotations, shaped_joints(body, betas), translation=translation)
    points = torch.rand(20, 3, dtype=torch.float64)
    weights = torch.softmax(torch.randn(20, 55, dtype=torch.float64), 1)
    by_blend = (blend(weights, bones) @ torch.cat([points, torch.ones(20, 1)], 1).unsqueeze(-1))[:, :3, 0]
    torch.testing.assert_close(skin(points, weights, bones), by_blend)
    torch.testing.assert_close(
        rigid_inverse(bones) @ bones, torch.eye(4, dtype=torch.float64).expand(55, 4, 4)
    )


def test_joints_of_the_independent_file(shared_folder: Path) -> None:
    path = shared_folder / "body" / "anny_smplx_format.npz"
    if not path.is_file():
        pytest.skip("no body model beside the checkout (../shared/body)")
    body: BodyModel = load_body(path)
    with np.load(path, allow_pickle=False) as file:
        betas = np.linspace(-2, 2, 10)
        wanted = file["J_regressor"].astype(float) @ (file["v_template"] + file["shapedirs"] @ betas)
        assert tuple(file["joint_names"]) == body.joint_names
    np.testing.assert_allclose(shaped_joints(body, torch.from_numpy(betas)).numpy(), wanted, atol=1e-5)

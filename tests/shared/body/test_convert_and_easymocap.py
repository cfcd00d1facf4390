"""Poses of another model and of another program, against the vertices they should give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.shared.body import BodyModel, Poses, embedded_body, posed_vertices
from stages.shared.body.convert import convert_betas, convert_poses, turned_poses
from stages.shared.errors import BadData
from stages.shared.poses import load_poses


def vertices(body: BodyModel, poses: Poses, frame: int) -> np.ndarray:
    parts = (poses.rotations[frame], poses.translation[frame], poses.betas, poses.expression[frame])
    return posed_vertices(body, *(torch.from_numpy(part).double() for part in parts)).numpy()


def some_poses(frames: int = 3) -> Poses:
    random = np.random.default_rng(5)
    rotations = random.normal(0, 0.3, (frames, 55, 3))
    rotations[:, 0] = random.normal(0, 1.5, (frames, 3))
    rotations[:, 22:] = 0
    translation, betas = random.normal(0, 1, (frames, 3)), random.normal(0, 1, 10)
    return Poses(rotations, translation, betas, np.zeros((frames, 10)), 30.0)


def gendered(body: BodyModel) -> BodyModel:
    """Another mean shape and other directions for the same people: the space of `body`, mixed and moved."""
    random = np.random.default_rng(6)
    mixing = np.linalg.qr(random.normal(size=(10, 10)))[0] * random.uniform(0.8, 1.2, 10)
    mean = body.template_vertices + body.shape_directions @ random.normal(0, 0.5, 10).astype(np.float32)
    return replace(
        body, template_vertices=mean, shape_directions=body.shape_directions @ mixing.astype(np.float32)
    )


def test_a_gendered_fit_gives_the_same_vertices_in_the_neutral_model() -> None:
    neutral = embedded_body()
    female = gendered(neutral)
    given = some_poses()
    found = convert_poses(given, female, neutral)
    for frame in range(len(given)):
        away = np.linalg.norm(vertices(neutral, found, frame) - vertices(female, given, frame), axis=1)
        assert away.max() < 1e-4
    assert np.abs(found.betas - given.betas).max() > 0.1  # there was something to convert
    np.testing.assert_array_equal(found.rotations, given.rotations)


def test_the_least_squares_shape_is_the_best_one() -> None:
    neutral = embedded_body()
    rough = np.random.default_rng(7).normal(0, 0.002, neutral.template_vertices.shape).astype(np.float32)
    other = replace(neutral, template_vertices=neutral.template_vertices + rough)
    betas = np.full(10, 0.7)
    found = convert_betas(betas, other, neutral)

    def error(values: np.ndarray) -> float:
        difference = neutral.shape_directions @ values - rough - neutral.shape_directions @ betas
        return float((difference**2).sum())

    for step in 0.02 * np.eye(10):
        assert error(found) < min(error(found + step), error(found - step))


def test_models_with_other_vertices_are_refused_and_the_same_one_changes_nothing() -> None:
    body, poses = embedded_body(), some_poses(1)
    assert convert_poses(poses, body, body) is poses
    less = replace(body, template_vertices=body.template_vertices[:-1])
    with pytest.raises(BadData, match="vertices"):
        convert_poses(poses, less, body)


def test_turned_poses_turn_the_vertices() -> None:
    body, poses = embedded_body(), some_poses(2)
    turn = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    turned = turned_poses(body, poses, turn)
    for frame in range(2):
        np.testing.assert_allclose(
            vertices(body, turned, frame), vertices(body, poses, frame) @ turn.T, atol=1e-5
        )


def with_hands(body: BodyModel) -> BodyModel:
    random = np.random.default_rng(8)
    components = np.linalg.qr(random.normal(size=(45, 45)))[0].astype(np.float32)
    mean = random.normal(0, 0.1, 45).astype(np.float32)
    return replace(
        body,
        hand_components_left=components,
        hand_components_right=-components,
        hand_mean_left=mean,
        hand_mean_right=-mean,
    )


@pytest.mark.parametrize("with_root", [True, False])
def test_easymocap_turns_about_the_origin(tmp_path: Path, with_root: bool) -> None:
    body, wanted = with_hands(embedded_body()), some_poses()
    random = np.random.default_rng(9)
    count = 6 if with_root else 12
    left, right = random.normal(0, 0.3, (2, 3, count))
    face = random.normal(0, 0.1, (3, 9)) if with_root else np.zeros((3, 0))
    body_angles = wanted.rotations[:, 1:22].reshape(3, 63)
    parts = [np.zeros((3, 3))] if with_root else []
    values = np.concatenate([*parts, body_angles, left, right, face], axis=1)
    assert values.shape == (3, 87)
    move = random.normal(0, 1, (3, 3))
    path = tmp_path / "fit.npz"
    np.savez(path, poses=values, Rh=wanted.rotations[:, 0], Th=move, shapes=wanted.betas[None])
    found = load_poses(path, body)
    # The same body without a root's turn, then turned and moved about the origin: what EasyMocap does.
    local = found.rotations.copy()
    local[:, 0] = 0
    still = replace(found, rotations=local, translation=np.zeros((3, 3), np.float32))
    for frame in range(3):
        turn = Rotation.from_rotvec(wanted.rotations[frame, 0]).as_matrix()
        expected = vertices(body, still, frame) @ turn.T + move[frame]
        np.testing.assert_allclose(vertices(body, found, frame), expected, atol=1e-5)
    np.testing.assert_allclose(found.rotations[:, 1:22], wanted.rotations[:, 1:22], atol=1e-6)
    assert body.hand_components_left is not None and body.hand_mean_left is not None
    hand = left @ body.hand_components_left[:count] + (0 if with_root else body.hand_mean_left)
    np.testing.assert_allclose(found.rotations[:, 25:40].reshape(3, 45), hand, atol=1e-5)
    if with_root:
        np.testing.assert_allclose(found.rotations[:, 22], face[:, :3], atol=1e-6)


def test_easymocap_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "fit.npz"
    np.savez(path, poses=np.ones((2, 87)), Rh=np.zeros((2, 3)), Th=np.zeros((2, 3)), shapes=np.zeros((1, 10)))
    with pytest.raises(BadData, match="body model"):
        load_poses(path)
    with pytest.raises(BadData, match="hand"):
        load_poses(path, embedded_body())
    for columns in (71, 90, 160):
        np.savez(path, poses=np.zeros((2, columns)), Rh=np.zeros((2, 3)), Th=np.zeros((2, 3)))
        with pytest.raises(BadData, match=f"poses has shape .2, {columns}"):
            load_poses(path, embedded_body())
    np.savez(path, poses=np.ones((2, 72)), Rh=np.zeros((2, 3)), Th=np.zeros((2, 3)))
    with pytest.raises(BadData, match="turns the root, and so does Rh"):
        load_poses(path, embedded_body())

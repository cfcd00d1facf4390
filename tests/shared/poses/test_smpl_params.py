"""Pose sequences and the layout `smpl_params.npz`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.shared.body import Poses, load_body
from stages.shared.body.npz import NumericNpz
from stages.shared.errors import BadData
from stages.shared.poses import load_poses
from stages.shared.poses.npz_layouts import read_pose_arrays


def some_poses(frames: int = 5) -> Poses:
    random = np.random.default_rng(11)
    return Poses(
        random.normal(0, 0.5, (frames, 55, 3)).astype(np.float32),
        random.normal(0, 1, (frames, 3)).astype(np.float32),
        random.normal(0, 1, 10).astype(np.float32),
        random.normal(0, 1, (frames, 10)).astype(np.float32),
        24.0,
    )


def as_the_papers_file(frames: int = 4, **changes: np.ndarray | None) -> dict[str, np.ndarray]:
    random = np.random.default_rng(12)
    arrays: dict[str, np.ndarray | None] = {
        "betas": random.normal(0, 1, (1, 10)),
        "global_orient": random.normal(0, 1, (frames, 3)),
        "transl": random.normal(0, 1, (frames, 3)),
        "body_pose": random.normal(0, 1, (frames, 63)),
        "jaw_pose": random.normal(0, 0.1, (frames, 3)),
        "expression": random.normal(0, 1, (frames, 10)),
        "left_hand_pose": random.normal(0, 1, (frames, 45)),
        "right_hand_pose": random.normal(0, 1, (frames, 45)),
        **changes,
    }
    return {name: values for name, values in arrays.items() if values is not None}


def test_round_trip_keeps_every_number_and_every_byte(tmp_path: Path) -> None:
    poses = some_poses()
    poses.save(tmp_path / "smpl_params.npz")
    again = load_poses(tmp_path / "smpl_params.npz")
    for name in ("rotations", "translation", "betas", "expression"):
        assert np.array_equal(getattr(again, name), getattr(poses, name))
    assert again.fps == 24.0
    assert again.to_npz_bytes() == poses.to_npz_bytes() == (tmp_path / "smpl_params.npz").read_bytes()


def test_slicing() -> None:
    poses = some_poses()
    assert len(poses[1:4]) == 3 and len(poses[-1]) == 1 and len(poses[[0, 4]]) == 2
    assert np.array_equal(poses[2].rotations[0], poses.rotations[2])
    assert np.array_equal(poses[1:4].expression, poses.expression[1:4])


def test_places_of_the_joints(tmp_path: Path) -> None:
    arrays = as_the_papers_file(leye_pose=np.full((4, 3), 0.1), reye_pose=np.full((4, 3), 0.2))
    np.savez(tmp_path / "p.npz", **arrays)
    poses = load_poses(tmp_path / "p.npz")
    assert poses.fps == 30.0
    np.testing.assert_allclose(poses.rotations[:, 4], arrays["body_pose"][:, 9:12], rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 22], arrays["jaw_pose"], rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 24], 0.2, rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 39], arrays["left_hand_pose"][:, 42:], rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 40], arrays["right_hand_pose"][:, :3], rtol=1e-6)


def test_hand_coefficients_are_expanded_with_the_mean(tmp_path: Path, smplx_file: Path) -> None:
    body = load_body(smplx_file)
    coefficients = np.random.default_rng(1).normal(0, 1, (4, 12))
    np.savez(tmp_path / "p.npz", **as_the_papers_file(left_hand_pose=coefficients))
    got = load_poses(tmp_path / "p.npz", body).rotations[:, 25:40].reshape(4, 45)
    wanted = coefficients @ body.hand_components_left[:12] + body.hand_mean_left
    np.testing.assert_allclose(got, wanted, atol=1e-5)
    np.savez(
        tmp_path / "flat.npz",
        **as_the_papers_file(left_hand_pose=coefficients),
        flat_hand_mean=np.array(True),
    )
    flat = load_poses(tmp_path / "flat.npz", body).rotations[:, 25:40].reshape(4, 45)
    np.testing.assert_allclose(flat, coefficients @ body.hand_components_left[:12], atol=1e-5)
    np.savez(tmp_path / "mean.npz", **as_the_papers_file(), flat_hand_mean=np.array(False))
    shifted = load_poses(tmp_path / "mean.npz", body).rotations[:, 40:].reshape(4, 45)
    np.testing.assert_allclose(
        shifted, as_the_papers_file()["right_hand_pose"] + body.hand_mean_right, atol=1e-5
    )


def test_hand_coefficients_without_a_hand_space_say_what_to_do(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", **as_the_papers_file(right_hand_pose=np.ones((4, 12))))
    with pytest.raises(BadData, match="--body-model"):
        load_poses(tmp_path / "p.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_pose": np.zeros((4, 60))}, "expected 63 or 69"),
        ({"body_pose": np.full((4, 63), np.nan)}, "NaN"),
        ({"transl": None}, "lacks the array 'transl'"),
        ({"transl": np.zeros((3, 3))}, "3 rows"),
        ({"left_hand_pose": np.zeros((4, 50))}, "45"),
        ({"betas": np.stack([np.zeros(10), np.ones(10)])}, "shape changes"),
        ({"global_orient": np.array([["a"] * 3] * 4)}, "not numeric"),
        ({"expression": np.array([[{}]] * 4, dtype=object)}, "Python objects"),
        ({"fps": np.array(-3.0)}, "frame rate"),
        ({"body_pose": np.zeros((0, 63))}, "0 frames"),
    ],
)
def test_wrong_parameters_are_refused(tmp_path: Path, changes: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "p.npz", **as_the_papers_file(**changes))
    with pytest.raises(BadData, match=message):
        load_poses(tmp_path / "p.npz", one_person=True)


def test_more_betas_than_ten_are_left_out_and_fewer_filled_up(tmp_path: Path) -> None:
    for columns in (16, 4):
        betas = np.arange(columns, dtype=float)[None]
        np.savez(tmp_path / "p.npz", **as_the_papers_file(betas=betas))
        got = load_poses(tmp_path / "p.npz").betas
        np.testing.assert_array_equal(got[: min(columns, 10)], betas[0, :10])
        assert not got[columns:].any()


def test_an_array_larger_than_allowed_is_not_unpacked(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "p.npz", **as_the_papers_file(expression=np.zeros((4, 4000))))
    with NumericNpz(tmp_path / "p.npz", "a pose file", limit=10_000) as file:
        assert file.shape("expression") == (4, 4000)
        with pytest.raises(BadData, match="MiB"):
            read_pose_arrays(file, None, print)

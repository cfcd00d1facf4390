"""Pose vectors of AMASS: places of the joints, the world's axes, frame rates, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.shared.body import embedded_body, posed_vertices
from stages.shared.errors import BadData, MissingInput
from stages.shared.poses import load_poses


def vectors(columns: int, frames: int = 6) -> np.ndarray:
    return np.random.default_rng(columns).normal(0, 0.4, (frames, columns))


def write(path: Path, poses: np.ndarray, **more: np.ndarray) -> Path:
    arrays = {"trans": np.random.default_rng(0).normal(0, 1, (len(poses), 3)), "betas": np.ones(16)}
    np.savez(path, poses=poses, **{**arrays, **more})
    return path


def test_smplh_hands_are_not_read_as_a_face(tmp_path: Path) -> None:
    values = vectors(156)
    poses = load_poses(write(tmp_path / "a.npz", values, mocap_framerate=np.array(120.0)))
    assert poses.fps == 120.0
    np.testing.assert_allclose(poses.rotations[:, 1:22].reshape(6, 63), values[:, 3:66], rtol=1e-6)
    assert not poses.rotations[:, 22:25].any()
    np.testing.assert_allclose(poses.rotations[:, 25:40].reshape(6, 45), values[:, 66:111], rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 40:].reshape(6, 45), values[:, 111:], rtol=1e-6)
    assert not poses.betas.any()


def test_smplx_with_arrays_of_objects_beside(tmp_path: Path) -> None:
    values = vectors(165)
    labels = np.array(["a", None], dtype=object)
    path = write(
        tmp_path / "a.npz", values, mocap_frame_rate=np.array(60), gender=np.array("x"), markers=labels
    )
    poses = load_poses(path)
    assert poses.fps == 60.0
    np.testing.assert_allclose(poses.rotations[:, 1:].reshape(6, 162), values[:, 3:], rtol=1e-6)


def test_the_same_body_stands_upright(tmp_path: Path) -> None:
    """Posing with the values as they are and turning the vertices must equal posing with what was read."""
    body, values = embedded_body(), vectors(165, 2)
    path = write(tmp_path / "a.npz", values)
    poses = load_poses(path, body)
    with np.load(path) as file:
        translation = file["trans"]
    zero = torch.zeros(10, dtype=torch.float64)
    given = posed_vertices(
        body, torch.from_numpy(values.reshape(2, 55, 3)), torch.from_numpy(translation), zero
    )
    upright = given.numpy() @ Rotation.from_euler("x", -90, degrees=True).as_matrix().T
    got = posed_vertices(
        body, torch.from_numpy(poses.rotations).double(), torch.from_numpy(poses.translation).double(), zero
    )
    np.testing.assert_allclose(got.numpy(), upright, atol=1e-5)


@pytest.mark.parametrize(
    ("poses", "more", "message"),
    [
        (vectors(160), {}, r"\(6, 160\)"),
        (vectors(165) * np.nan, {}, "NaN"),
        (vectors(165), {"trans": np.zeros((5, 3))}, "trans has 5 rows"),
        (vectors(165), {"mocap_framerate": np.array(0.0)}, "frame rate"),
        (np.zeros((0, 165)), {}, "0 frames"),
        (np.zeros(165), {}, r"\(165,\)"),
    ],
)
def test_wrong_vectors_are_refused(
    tmp_path: Path, poses: np.ndarray, more: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(BadData, match=message):
        load_poses(write(tmp_path / "a.npz", poses, **more))


def test_other_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(BadData, match="no body poses"):
        load_poses(tmp_path / "other.npz")
    (tmp_path / "clip.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(BadData, match="not a pose file of a known kind"):
        load_poses(tmp_path / "clip.fbx")
    with pytest.raises(MissingInput):
        load_poses(tmp_path / "nothing.npz")

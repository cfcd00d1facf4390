"""Motions of other worlds and with other hands; the command that writes them down."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.body import Poses, embedded_body, posed_vertices
from stages.shared.body.skeleton import JOINT_INDEX
from stages.shared.errors import UsageProblem
from stages.shared.poses import load_poses
from stages.shared.poses.convert import amass_corrected, with_hands
from tests.shared.poses.test_amass import vectors, write

SEED = np.random.default_rng(3)


def _motion(frames: int = 4) -> Poses:
    return Poses(
        SEED.normal(0, 0.4, (frames, 55, 3)).astype(np.float32),
        SEED.normal(0, 1, (frames, 3)).astype(np.float32),
        np.zeros(10, np.float32),
        np.zeros((frames, 10), np.float32),
    )


def _vertices(poses: Poses, frame: int) -> np.ndarray:
    rotations, translation = (
        torch.from_numpy(a[frame]).double() for a in (poses.rotations, poses.translation)
    )
    return posed_vertices(embedded_body(), rotations, translation, torch.zeros(10).double()).numpy()


def test_z_up_files_stand_upright(tmp_path: Path) -> None:
    """Posing what the file says and turning the vertices equals posing what was read."""
    motion, body = _motion(), embedded_body()
    (tmp_path / "z.npz").write_bytes(motion.to_npz_bytes())
    upright = load_poses(tmp_path / "z.npz", body, up="z")
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    for frame in (0, 3):
        np.testing.assert_allclose(_vertices(upright, frame), _vertices(motion, frame) @ turn.T, atol=2e-5)
    for up in ("y", "auto"):
        same = load_poses(tmp_path / "z.npz", body, up=up)
        np.testing.assert_array_equal(same.rotations, motion.rotations)


def test_amass_vectors_of_a_y_up_world_are_left(tmp_path: Path) -> None:
    values = vectors(165)
    path = write(tmp_path / "a.npz", values)
    kept, turned = load_poses(path, up="y"), load_poses(path, up="z")
    np.testing.assert_allclose(kept.rotations[:, 0], values[:, :3], rtol=1e-6)
    with np.load(path) as file:
        np.testing.assert_allclose(kept.translation, file["trans"], rtol=1e-6)
    assert np.abs(turned.rotations[:, 0] - kept.rotations[:, 0]).max() > 0.5
    np.testing.assert_array_equal(turned.rotations, load_poses(path).rotations)


def test_files_of_animatable_gaussians(tmp_path: Path) -> None:
    """Their keys: one row of betas, 45-value hands on a flat hand, no eyes, no frame rate; others beside."""
    frames = {"global_orient": 3, "transl": 3, "jaw_pose": 3, "body_pose": 63, "expression": 10}
    arrays = {name: SEED.normal(0, 0.3, (5, width)) for name, width in frames.items()}
    arrays |= {f"{side}_hand_pose": SEED.normal(0, 0.3, (5, 45)) for side in ("left", "right")}
    np.savez(tmp_path / "smpl_params.npz", betas=np.full((1, 10), 0.5), extra=np.ones((2, 2)), **arrays)
    poses = load_poses(tmp_path / "smpl_params.npz", embedded_body())
    assert poses.fps == 30 and len(poses) == 5 and (poses.betas == 0.5).all()
    np.testing.assert_allclose(poses.rotations[:, 40:55].reshape(5, 45), arrays["right_hand_pose"], rtol=1e-6)
    np.testing.assert_allclose(poses.rotations[:, 22], arrays["jaw_pose"], rtol=1e-6)
    assert not poses.rotations[:, 23:25].any()


def test_hands_and_corrections_touch_nothing_else() -> None:
    motion, body = _motion(), embedded_body()
    body = replace(
        body, hand_mean_left=np.full(45, 0.1, np.float32), hand_mean_right=np.full(45, 0.2, np.float32)
    )
    flat, relaxed = with_hands(motion, "flat"), with_hands(motion, "relaxed", body)
    for changed in (flat, relaxed):
        np.testing.assert_array_equal(changed.rotations[:, :25], motion.rotations[:, :25])
    assert not flat.rotations[:, 25:].any()
    assert (relaxed.rotations[:, 25:40] == np.float32(0.1)).all()
    assert (relaxed.rotations[:, 40:] == np.float32(0.2)).all()
    assert with_hands(motion, "file") is motion
    corrected = amass_corrected(motion).rotations - motion.rotations
    left, right, head = (JOINT_INDEX[name] for name in ("left_collar", "right_collar", "head"))
    np.testing.assert_allclose(corrected[:, left], [[0, 0, 0.3]] * 4, atol=1e-6)
    np.testing.assert_allclose(corrected[:, right], [[0, 0, -0.3]] * 4, atol=1e-6)
    np.testing.assert_allclose(corrected[:, head, 0], -motion.rotations[:, head, 0])
    touched = set(np.flatnonzero(np.abs(corrected).max(axis=(0, 2))))
    assert touched == {left, right, head, JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]}
    with pytest.raises(UsageProblem, match="fists"):
        with_hands(motion, "fists")
    with pytest.raises(UsageProblem, match="relaxed"):
        with_hands(motion, "relaxed", replace(body, hand_mean_left=None))


def test_command_writes_what_every_command_reads(tmp_path: Path) -> None:
    path = write(tmp_path / "a.npz", vectors(156, 13), mocap_framerate=np.array(60.0))
    out = tmp_path / "walk.npz"
    words = [
        "poses",
        str(path),
        "-o",
        str(out),
        "--fps",
        "30",
        "--hands",
        "flat",
        "--frames",
        "1:5:2",
        "--json",
    ]
    dry = CliRunner().invoke(app, [*words, "--dry-run"])
    assert dry.exit_code == 0 and not out.exists()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["frames"] == 2
    written = load_poses(out)
    np.testing.assert_allclose(
        written.rotations[:, 1:22], load_poses(path).rotations[[2, 6], 1:22], atol=1e-6
    )
    assert written.fps == 30 and not written.rotations[:, 25:].any()
    for wrong, code in ((["--up", "w"], 2), (["--hands", "fists"], 2), (["--frames", "99:"], 2)):
        assert CliRunner().invoke(app, [*words, *wrong]).exit_code == code
    (tmp_path / "no.npz").write_bytes(b"nothing")
    assert CliRunner().invoke(app, ["poses", str(tmp_path / "no.npz"), "-o", str(out)]).exit_code == 65

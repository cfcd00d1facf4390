"""Bad captures through the command line: three lines, the right exit code, nothing half-written."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from gw_cli.app import app
from stages.shared.artifacts.bundle import write_bundle
from stages.shared.artifacts.files import using_layer
from stages.shared.body.poses import npz_bytes
from stages.shared.layers import LABELS
from tests.crash.fake_stage import FailingLayer
from tests.shared.capture import scene
from tests.shared.capture.people import FRAMES, SIDE, rest_poses, write_person
from tests.shared.outfit.wardrobe import bundle, worn

WALK = Path("takes/walk")


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bare body in its rest pose, seen by three cameras."""
    return write_person(tmp_path_factory.mktemp("person") / "capture")


def run(*arguments: object) -> tuple[int, list[str]]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.stderr.splitlines()


def artifacts(subject: Path) -> list[Path]:
    return list(subject.rglob("manifest.json")) + list(subject.glob("*.npz")) if subject.exists() else []


def test_the_capture_itself_is_fine(person: Path, tmp_path: Path) -> None:
    """The cases below fail for the reason they say, and for no other."""
    code, lines = run("register-template", person, "-o", tmp_path / "subject", "--template", "body")
    assert code == 0, lines
    assert artifacts(tmp_path / "subject")


def nan_poses(root: Path) -> None:
    arrays = {**rest_poses().to_arrays(), "transl": np.full((FRAMES, 3), np.nan, np.float32)}
    (root / WALK / "smpl_params.npz").write_bytes(npz_bytes(arrays))


def wrong_columns(root: Path) -> None:
    (root / WALK / "smpl_params.npz").write_bytes(npz_bytes({"body_pose": np.zeros((2, 160), np.float32)}))


def truncated_mask(root: Path) -> None:
    for path in (root / WALK / "masks/cam1").iterdir():
        path.write_bytes(path.read_bytes()[:-20])


def empty_masks(root: Path) -> None:
    for path in (root / WALK / "masks/cam1").iterdir():
        cv2.imwrite(str(path), np.zeros((SIDE, SIDE), np.uint8))


def missing_camera(root: Path) -> None:
    for path in (root / WALK / "rgb/cam2").iterdir():
        path.unlink()
    (root / WALK / "rgb/cam2").rmdir()


def moved_person(root: Path) -> None:
    """The person is elsewhere than the poses say."""
    (root / WALK / "smpl_params.npz").write_bytes(rest_poses((1.2, 0.0, 0.0)).to_npz_bytes())


def pickled_body(root: Path) -> None:
    (root / "body_model.npz").write_bytes(b"\x80\x04N.")


SPOILED: dict[str, tuple[Callable[[Path], None], int, str]] = {
    "NaN poses": (nan_poses, 65, "transl"),
    "160 columns": (wrong_columns, 65, "160"),
    "truncated mask": (truncated_mask, 65, "masks/cam1/00000"),
    "missing camera": (missing_camera, 66, "cam2"),
    "poses that do not fit": (moved_person, 65, "as is"),
    "pickled body": (pickled_body, 65, "body_model.npz"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_spoiled_capture(person: Path, tmp_path: Path, name: str) -> None:
    spoil, code, place = SPOILED[name]
    root = scene.copy(person, tmp_path / "capture")
    spoil(root)
    found, lines = run("register-template", root, "-o", tmp_path / "subject", "--template", "body")
    assert found == code, lines
    expect_three_lines(lines, place)
    assert not artifacts(tmp_path / "subject")


def test_a_person_who_leaves_a_view_costs_that_view(person: Path, tmp_path: Path) -> None:
    root = scene.copy(person, tmp_path / "capture")
    empty_masks(root)
    code, lines = run("register-template", root, "-o", tmp_path / "subject", "--template", "body")
    assert code == 0, lines
    (warning,) = [line for line in lines if "nobody is seen by" in line]
    assert "cam1, frame 0" in warning and "cam1, frame 1" in warning


def test_labels_with_unknown_ids_stop_the_first_stage_that_reads_them(person: Path, tmp_path: Path) -> None:
    root, subject = scene.copy(person, tmp_path / "capture"), tmp_path / "subject"
    for path in (root / WALK / "labels").rglob("*.png"):
        cv2.imwrite(str(path), np.full((SIDE, SIDE), 77, np.uint8))
    assert 77 not in LABELS
    code, lines = run("register-template", root, "-o", subject, "--template", "body", "--preset", "tiny")
    assert code == 65, lines
    expect_three_lines(lines, "labels/cam")
    assert "77" in "".join(lines[-3:]) and not artifacts(subject)


def test_labels_spoiled_later_stop_the_segmentation(person: Path, tmp_path: Path) -> None:
    root, subject = scene.copy(person, tmp_path / "capture"), tmp_path / "subject"
    assert run("register-template", root, "-o", subject, "--template", "body", "--preset", "tiny")[0] == 0
    for path in (root / WALK / "labels").rglob("*.png"):
        cv2.imwrite(str(path), np.full((SIDE, SIDE), 77, np.uint8))
    assert run("canonicalize", subject, "--preset", "tiny")[0] == 0
    before = artifacts(subject)
    code, lines = run("segment-layers", subject, "--preset", "tiny")
    assert code == 65, lines
    expect_three_lines(lines, "labels/cam")
    assert "77" in "".join(lines[-3:])
    assert artifacts(subject) == before


@pytest.mark.parametrize(
    ("content", "code", "says"),
    [
        ("element vertex 3\n{xyz}end_header\n0 0 0\n1 0 0\n0 1 0\n", 65, "no faces"),
        ("element vertex 3\n{xyz}{face}end_header\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", 65, "NaN"),
        ("element vertex 3\n{xyz}{face}end_header\n0 0 0\n", 65, "ends early"),
    ],
)
@pytest.mark.parametrize("command", ["register-template", "canonicalize"])
def test_spoiled_mesh(tmp_path: Path, command: str, content: str, code: int, says: str) -> None:
    path, subject = tmp_path / "mesh.ply", tmp_path / "subject"
    xyz = "property float x\nproperty float y\nproperty float z\n"
    face = "element face 1\nproperty list uchar int vertex_indices\n"
    path.write_text("ply\nformat ascii 1.0\n" + content.format(xyz=xyz, face=face))
    found, lines = run(command, path, "-o", subject)
    assert found == code, lines
    expect_three_lines(lines, "mesh.ply")
    assert says in lines[-3]
    assert not artifacts(subject)


def test_a_full_disk(person: Path, tmp_path: Path) -> None:
    subject = tmp_path / "subject"
    with using_layer(FailingLayer(at=25, code=errno.ENOSPC)):
        found, lines = run("register-template", person, "-o", subject, "--template", "body")
    assert found == 74, lines
    expect_three_lines(lines, str(subject))
    assert "full" in lines[-3]
    assert not artifacts(subject)
    assert run("register-template", person, "-o", subject, "--template", "body")[0] == 0


@pytest.mark.parametrize(("columns", "value", "says"), [(160, 0.0, "160"), (165, np.nan, "NaN")])
def test_a_motion_nobody_can_wear(tmp_path: Path, columns: int, value: float, says: str) -> None:
    motion, out = tmp_path / "motion.npz", tmp_path / "out"
    poses = np.full((4, columns), value, np.float32)
    motion.write_bytes(npz_bytes({"poses": poses, "trans": np.zeros((4, 3), np.float32)}))
    body = tmp_path / "body.gwg"
    write_bundle(body, bundle(worn("body")))
    found, lines = run("tryon", body, "--poses", motion, "-o", out)
    assert found == 65, lines
    expect_three_lines(lines, "motion.npz")
    assert says in "".join(lines[-3:])
    assert not out.exists()


def test_no_capture_at_all(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    found, lines = run("register-template", tmp_path / "photos", "-o", tmp_path / "subject")
    assert found == 66
    expect_three_lines(lines, "photos")
    assert not (tmp_path / "subject").exists() or not artifacts(tmp_path / "subject")


def expect_three_lines(lines: list[str], place: str) -> None:
    what, where, fix = lines[-3:]
    assert what.startswith("error: ") and where.startswith(" where: ") and fix.startswith("   fix: ")
    assert place in what + where
    assert not any("Traceback" in line for line in lines)

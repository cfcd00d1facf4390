"""Captures with one thing wrong: an error that names the file and what to do, with the right exit code."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.body.poses import npz_bytes
from stages.shared.capture import open_capture
from stages.shared.errors import BadData, GwError, MissingInput, UsageProblem
from tests.shared.capture import scene

WALK = Path("takes/walk")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write_native(tmp_path_factory.mktemp("good") / "ball", frames=2)


def read_everything(root: Path) -> None:
    """What the stages do with a capture, in short."""
    for take in open_capture(root).takes:
        for camera in take.cameras:
            for frame in take.frames:
                if take.has_image(camera, frame):
                    take.image(camera, frame)
                    take.labels(camera, frame)
                    take.subject_box(camera, frame)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def edit_json(path: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_poses(root: Path, **arrays: np.ndarray) -> None:
    content = scene.poses(2).to_arrays()
    (root / WALK / "smpl_params.npz").write_bytes(npz_bytes({**content, **arrays}))


def turned(values: list[list[float]]) -> list[list[float]]:
    return (1.05 * np.array(values)).tolist()


def nan_poses(root: Path) -> None:
    values = np.zeros((2, 3), np.float32)
    values[1, 2] = np.nan
    edit_poses(root, transl=values)


def write_labels(root: Path) -> None:
    cv2.imwrite(str(root / WALK / "labels/cam1/000001.png"), np.full((48, 64), 17, np.uint8))


def other_size(root: Path) -> None:
    cv2.imwrite(str(root / WALK / "rgb/cam1/000001.png"), np.zeros((24, 32, 3), np.uint8))


def remove(root: Path, folder: str) -> None:
    for path in sorted((root / folder).rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (root / folder).rmdir()


def entry(number: int, **values: object) -> Callable[[dict], None]:
    return lambda content: content["cameras"][number].update(values)


def scaled_rotation(content: dict) -> None:
    matrix = np.array(content["cameras"][1]["camera_from_world"])
    matrix[:3, :3] *= 1.05
    content["cameras"][1]["camera_from_world"] = matrix.tolist()


NAN = float("nan")
# name: (what is done to a good capture, type of the error, in the sentence, in the place)
CASES: dict[str, tuple[Callable[[Path], object], type[GwError], str, str]] = {
    "truncated image": (
        lambda r: cut(r / WALK / "rgb/cam1/000001.png"),
        BadData,
        "damaged",
        "rgb/cam1/000001.png",
    ),
    "truncated mask": (
        lambda r: cut(r / WALK / "masks/cam1/000001.png"),
        BadData,
        "damaged",
        "masks/cam1/000001",
    ),
    "truncated labels": (
        lambda r: cut(r / WALK / "labels/cam1/000001.png"),
        BadData,
        "damaged",
        "labels/cam1",
    ),
    "no images of a camera": (
        lambda r: remove(r, "takes/walk/rgb/cam1"),
        MissingInput,
        "Camera cam1",
        "walk",
    ),
    "no masks of a camera": (
        lambda r: remove(r, "takes/walk/masks/cam2"),
        MissingInput,
        "Camera cam2",
        "walk",
    ),
    "no poses": (lambda r: (r / WALK / "smpl_params.npz").unlink(), MissingInput, "pose", "smpl_params.npz"),
    "NaN poses": (nan_poses, BadData, "NaN", "transl[1, 2]"),
    "62 columns": (
        lambda r: edit_poses(r, body_pose=np.zeros((2, 62), np.float32)),
        BadData,
        "(2, 62)",
        "body_pose",
    ),
    "160 columns": (
        lambda r: (r / WALK / "smpl_params.npz").write_bytes(npz_bytes({"poses": np.zeros((2, 160))})),
        BadData,
        "(2, 160)",
        "smpl_params.npz",
    ),
    "pickled poses": (
        lambda r: (r / WALK / "smpl_params.npz").write_bytes(b"\x80\x04N."),
        BadData,
        "pickle",
        "smpl_params.npz",
    ),
    "cut poses": (lambda r: cut(r / WALK / "smpl_params.npz"), BadData, "cannot be read", "smpl_params.npz"),
    "unknown ids": (write_labels, BadData, "ids 17", "labels/cam1/000001.png"),
    "other size": (other_size, BadData, "32 x 24", "rgb/cam1/000001.png"),
    "no rotation": (
        lambda r: edit_json(r / "cameras.json", scaled_rotation),
        BadData,
        "no rotation",
        "camera 1",
    ),
    "NaN calibration": (
        lambda r: edit_json(r / "cameras.json", entry(0, intrinsics=[[NAN, 0, 1], [0, 1, 1], [0, 0, 1]])),
        BadData,
        "NaN",
        "cameras.json",
    ),
    "text as width": (
        lambda r: edit_json(r / "cameras.json", entry(0, width="wide")),
        BadData,
        "cam0",
        "camera 0",
    ),
    "name with a path": (
        lambda r: edit_json(r / "cameras.json", entry(0, name="../../x")),
        BadData,
        "no usable name",
        "camera 0",
    ),
    "two of a name": (
        lambda r: edit_json(r / "cameras.json", entry(0, name="cam1")),
        BadData,
        "cam1",
        "camera 1",
    ),
    "no cameras": (
        lambda r: (r / "cameras.json").write_text('{"cameras": []}'),
        BadData,
        "no cameras",
        "cameras.json",
    ),
    "no calibration": (lambda r: (r / "cameras.json").unlink(), MissingInput, "no file", "cameras.json"),
    "broken JSON": (lambda r: cut(r / "cameras.json"), BadData, "JSON", "cameras.json"),
    "deep JSON": (lambda r: (r / "cameras.json").write_text("[" * 200_000), BadData, "JSON", "cameras.json"),
    "take with a path": (
        lambda r: edit_json(r / "capture.json", lambda c: c["takes"][0].update(name="../walk")),
        BadData,
        "no usable name",
        "capture.json",
    ),
    "newer version": (
        lambda r: edit_json(r / "capture.json", lambda c: c.update(version=2)),
        BadData,
        "version 2",
        "capture.json",
    ),
    "unknown split": (
        lambda r: edit_json(r / "capture.json", lambda c: c["takes"][0].update(split="validation")),
        BadData,
        "validation",
        "walk",
    ),
    "body that is a pickle": (
        lambda r: (r / "body_model.npz").write_bytes(b"\x80\x04N."),
        BadData,
        "pickle",
        "body_model.npz",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_thing_wrong(good: Path, tmp_path: Path, name: str) -> None:
    spoil, kind, what, where = CASES[name]
    root = scene.copy(good, tmp_path / "ball")
    read_everything(root)
    spoil(root)
    with pytest.raises(kind) as caught:
        read_everything(root)
    assert what in caught.value.what
    assert where in caught.value.where
    assert caught.value.fix.endswith((".", ")"))
    assert "\n" not in caught.value.what + caught.value.where + caught.value.fix
    assert caught.value.exit_code == (65 if kind is BadData else 66)


def test_a_folder_that_is_no_capture(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(MissingInput) as caught:
        open_capture(tmp_path)
    for mark in ("capture.json", "calibration.csv", "cameras.pkl", "calibration.json", "holiday.jpg"):
        assert mark in caught.value.where
    with pytest.raises(MissingInput, match="no such folder"):
        open_capture(tmp_path / "nowhere")
    with pytest.raises(UsageProblem, match="no capture format"):
        open_capture(tmp_path, format="vhs")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("cam0,64,48,nan,0,0,0,0,0,1,1,.5,.5", "NaN"),
        ("cam0,64,48,x,0,0,0,0,0,1,1,.5,.5", "could not convert"),
        ("cam0,64,48,0,0,0", "lacks the column"),
        ("../cam0,64,48,0,0,0,0,0,0,1,1,.5,.5", "unusable"),
        ("cam0,64,48,0,0,0,0,0,0,-1,1,.5,.5", "focal length"),
        ("cam0,1e9,48,0,0,0,0,0,0,1,1,.5,.5", "invalid literal"),
    ],
)
def test_broken_calibration_tables(tmp_path: Path, line: str, says: str) -> None:
    root = scene.write_actorshq(tmp_path / "actor", frames=1)
    path = root / "Sequence1/1x/calibration.csv"
    path.write_text(path.read_text().splitlines()[0] + "\n" + line + "\n")
    with pytest.raises(BadData) as caught:
        open_capture(root)
    assert says in caught.value.what and "calibration.csv" in caught.value.where


def test_4d_dress_with_a_hostile_pickle(tmp_path: Path) -> None:
    root = scene.write_4d_dress(tmp_path / "00199" / "Inner", frames=1)
    mark = tmp_path / "touched"
    (root / "Take1/Capture/cameras.pkl").write_bytes(
        b"cos\nsystem\n(S'touch " + str(mark).encode() + b"'\ntR."
    )
    with pytest.raises(BadData, match=r"os\.system") as caught:
        open_capture(root)
    assert "cameras.pkl" in caught.value.where and not mark.exists()

"""The same ball written in every layout reads the same."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.body import embedded_body
from stages.shared.capture import Capture, open_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from tests.shared.capture import scene

WRITERS: dict[str, Callable[[Path], Path]] = {
    "actorshq": scene.write_actorshq,
    "thuman4": lambda path: scene.write_animatable(path, "thuman4"),
    "avatarrex": lambda path: scene.write_animatable(path, "avatarrex"),
    "4d-dress": scene.write_4d_dress,
}


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return open_capture(
        scene.write_native(tmp_path_factory.mktemp("native") / "ball", takes=("walk", "dance"))
    )


def test_native_reads_what_was_written(native: Capture) -> None:
    take = native.takes[0]
    assert native.format == "native" and [t.name for t in native.test_takes] == ["dance"]
    assert take.training_cameras == ("cam0", "cam1", "cam2") and take.heldout_cameras == ("cam3",)
    assert take.frames == [0, 1, 2] and take.fps == 30.0
    for camera in scene.ring():
        image, mask, labels = scene.picture(camera)
        np.testing.assert_array_equal(take.image(camera.name, 1), image)
        np.testing.assert_array_equal(take.mask(camera, 1), mask)
        np.testing.assert_array_equal(take.labels(camera.name, 1), labels)
        np.testing.assert_allclose(take.cameras[camera.name].camera_from_world, camera.camera_from_world)
    np.testing.assert_array_equal(take.poses.rotations, scene.poses(3).rotations)


@pytest.mark.parametrize("layout", WRITERS)
def test_layout_agrees_with_native(native: Capture, tmp_path: Path, layout: str) -> None:
    capture = open_capture(WRITERS[layout](tmp_path / "00199" / "Inner"))
    assert capture.format == layout
    expected, take = native.takes[0], capture.takes[0]
    assert take.frames == expected.frames and take.fps == expected.fps
    assert list(take.cameras) == list(expected.cameras)
    for name, camera in expected.cameras.items():
        np.testing.assert_allclose(take.cameras[name].camera_from_world, camera.camera_from_world, atol=1e-9)
        np.testing.assert_allclose(take.cameras[name].intrinsics, camera.intrinsics, atol=1e-9)
        np.testing.assert_array_equal(take.image(name, 2), expected.image(name, 2))
        np.testing.assert_array_equal(take.mask(name, 2), expected.mask(name, 2))
        np.testing.assert_array_equal(take.labels(name, 2), expected.labels(name, 2))
    for field in ("rotations", "translation", "betas", "expression"):
        np.testing.assert_allclose(getattr(take.poses, field), getattr(expected.poses, field), atol=1e-6)
    per_take = len(expected.cameras) * 3
    for group in ("images", "masks", "labels"):
        assert len(capture.files(group)) == per_take * len(capture.takes)
    assert all(path.is_file() for group in ("cameras", "poses") for path in capture.files(group))


def test_actorshq_takes_folders_at_three_levels(tmp_path: Path) -> None:
    root = scene.write_actorshq(tmp_path / "actor")
    for folder in (root, root / "Sequence1", root / "Sequence1" / "1x"):
        capture = open_capture(folder)
        assert [take.name for take in capture.takes] == ["Sequence1"]
        assert capture.takes[0].training_cameras == ("cam0", "cam1", "cam2")


def test_actorshq_prefers_the_small_scale(tmp_path: Path) -> None:
    root = scene.write_actorshq(tmp_path / "actor")
    (root / "Sequence1" / "1x").rename(root / "Sequence1" / "4x")
    scene.copy(root / "Sequence1" / "4x", root / "Sequence1" / "1x")
    assert open_capture(root).files("cameras")[0].parent.name == "4x"


def test_4d_dress_names_frames_and_splits_takes(tmp_path: Path) -> None:
    capture = open_capture(scene.write_4d_dress(tmp_path / "00199" / "Outer"))
    train, test = capture.takes
    assert (train.split, test.split) == ("train", "test")
    names = [train.view(next(iter(train.cameras)), frame).image.stem[-5:] for frame in train.frames]
    assert train.frames == [0, 1, 2] and names == ["00011", "00012", "00013"] and train.scan_frame == 0
    scan = train.read_scan()
    assert scan is not None and scan.labels is not None and scan.colors is not None
    np.testing.assert_array_equal(scan.labels, np.arange(20) % 5)
    np.testing.assert_allclose(scan.vertices, np.random.default_rng(1).normal(size=(20, 3)), rtol=1e-6)
    assert test.read_scan() is None


def test_4d_dress_subject_folder_needs_a_choice(tmp_path: Path) -> None:
    scene.write_4d_dress(tmp_path / "00199" / "Outer")
    assert open_capture(tmp_path / "00199").takes[0].name == "Take1"
    scene.write_4d_dress(tmp_path / "00199" / "Inner")
    with pytest.raises(UsageProblem, match="2 folders here have takes"):
        open_capture(tmp_path / "00199")


def test_4d_dress_takes_are_found_below_a_parent_folder(tmp_path: Path) -> None:
    scene.write_4d_dress(tmp_path / "copied" / "00901")
    for root in (tmp_path / "copied" / "00901", tmp_path / "copied", tmp_path):
        assert [take.name for take in open_capture(root).takes] == ["Take1", "Take2"]


def test_4d_dress_hand_coefficients(tmp_path: Path) -> None:
    root = scene.write_4d_dress(tmp_path / "00199" / "Inner", hand_columns=12)
    without = dataclasses.replace(embedded_body(), hand_components_left=None, hand_components_right=None)
    flat = open_capture(root, body=without)
    assert not flat.takes[0].poses.rotations[:, 25:].any()
    assert any("hands stay flat" in note for note in flat.notes)
    space = np.eye(45, dtype=np.float32)
    body = dataclasses.replace(
        embedded_body(),
        hand_components_left=space,
        hand_components_right=2 * space,
        hand_mean_left=np.full(45, 0.5, np.float32),
        hand_mean_right=np.zeros(45, np.float32),
    )
    hands = open_capture(root, body=body).takes[0].poses.rotations[:, 25:]
    given = scene.poses(3).rotations[:, 25:]
    np.testing.assert_allclose(hands[:, 0], given[:, 0] + 0.5, rtol=1e-5)
    np.testing.assert_allclose(hands[:, 15:19], 2 * given[:, 15:19], rtol=1e-5)
    np.testing.assert_allclose(hands[:, 19:], 0, atol=1e-7)  # beyond the 12 coefficients


def test_missing_images_shorten_the_take_and_are_reported(tmp_path: Path) -> None:
    root = scene.write_native(tmp_path / "ball", frames=4)
    (root / "takes/walk/rgb/cam1/000001.png").unlink()
    (root / "takes/walk/missing_img_files.txt").write_text("rgb/cam0/000002.png\n")
    take = open_capture(root).takes[0]
    assert take.frames == [0, 3]
    assert any(note.startswith("2 of 4 frames are left out") for note in take.notes)
    assert not take.has_image("cam0", 2) and take.has_image("cam1", 2)
    with pytest.raises(MissingInput, match="frame 2 by camera cam0"):
        take.image("cam0", 2)
    names = {path.name for path in open_capture(root).files("images")}
    assert names == {"000000.png", "000003.png"}


def test_a_heldout_camera_may_miss_images(tmp_path: Path) -> None:
    root = scene.write_native(tmp_path / "ball")
    (root / "takes/walk/rgb/cam3/000001.png").unlink()
    take = open_capture(root).takes[0]
    assert take.frames == [0, 1, 2] and not take.has_image("cam3", 1)


def test_frames_without_pose_are_left_out(tmp_path: Path) -> None:
    root = scene.write_native(tmp_path / "ball")
    (root / "takes/walk/smpl_params.npz").write_bytes(scene.poses(2).to_npz_bytes())
    take = open_capture(root).takes[0]
    assert take.frames == [0, 1] and any("only 2 rows" in note for note in take.notes)


def test_writer_leaves_nothing_when_it_fails(tmp_path: Path) -> None:
    from stages.shared.capture import native_writer

    with pytest.raises(RuntimeError), native_writer(tmp_path / "ball", scene.ring()) as writer:
        writer.take("walk", "train", scene.poses(1))
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = scene.write_native(tmp_path / "a"), scene.write_native(tmp_path / "b")
    for path in first.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (second / path.relative_to(first)).read_bytes(), path


def test_subject_box_is_around_the_mask(tmp_path: Path) -> None:
    root = scene.write_native(tmp_path / "ball")
    take = open_capture(root).takes[0]
    _, mask, _ = scene.picture(take.cameras["cam0"])
    rows, columns = np.nonzero(mask)
    left, top, right, bottom = take.subject_box("cam0", 0, margin=2) or (0, 0, 0, 0)
    assert (left, top) == (columns.min() - 2, rows.min() - 2)
    assert (right, bottom) == (columns.max() + 3, rows.max() + 3)
    assert take.subject_box("cam0", 0, margin=1000) == (0, 0, 64, 48)
    cv2.imwrite(str(take.view("cam0", 1).mask), np.full((48, 64), 127, np.uint8))
    assert take.subject_box("cam0", 1) is None


def test_a_moved_capture_is_found_by_its_settings(tmp_path: Path) -> None:
    from stages.shared.artifacts import Workspace
    from stages.shared.capture.subject import open_subject_capture, remember_capture

    capture = open_capture(scene.write_native(tmp_path / "one" / "ball"))
    (tmp_path / "one" / "subject").mkdir()
    remember_capture(Workspace(tmp_path / "one" / "subject"), capture, "inverted")
    (tmp_path / "one").rename(tmp_path / "two")
    found = open_subject_capture(Workspace(tmp_path / "two" / "subject"))
    np.testing.assert_allclose(
        found.takes[0].cameras["cam1"].camera_from_world,
        np.linalg.inv(capture.takes[0].cameras["cam1"].camera_from_world),
        atol=1e-12,
    )
    (tmp_path / "two" / "ball").rename(tmp_path / "elsewhere")
    with pytest.raises(MissingInput, match="not where it was"):
        open_subject_capture(Workspace(tmp_path / "two" / "subject"))


def test_real_capture_is_read_whole(subject_a: Path) -> None:
    capture = open_capture(subject_a)
    train, test = capture.takes
    assert (train.name, train.split, len(train.frames)) == ("Sequence1", "train", 200)
    assert (test.name, test.split, test.frames) == ("Sequence2", "test", list(range(4, 60, 5)))
    assert len(train.training_cameras) == 8 and train.heldout_cameras == ("Cam009",)
    assert train.cameras["Cam001"].centre == pytest.approx([0, 1, 3.3])
    assert len(test.poses) == 60 and test.scan_frame == 0
    assert len(capture.files("images")) == (200 + 12) * 9
    assert np.unique(train.labels("Cam002", 40)).tolist() == [0, 1, 2, 3, 4, 255]


def test_scene_json_may_be_absent(tmp_path: Path) -> None:
    root = scene.write_actorshq(tmp_path / "actor")
    (root / "Sequence1" / "scene.json").write_text(json.dumps({"num_frames": 3}))
    take = open_capture(root).takes[0]
    assert take.split == "train" and take.heldout_cameras == () and len(take.training_cameras) == 4


def test_two_files_of_one_frame_are_refused(tmp_path: Path) -> None:
    root = scene.write_native(tmp_path / "ball")
    folder = root / "takes/walk/rgb/cam0"
    (folder / "0001.png").write_bytes((folder / "000001.png").read_bytes())
    with pytest.raises(BadData, match="frame 1") as caught:
        open_capture(root)
    assert "0001.png" in caught.value.where


def test_a_camera_that_is_listed_for_training_must_have_images(tmp_path: Path) -> None:
    root = scene.write_actorshq(tmp_path / "actor")
    shutil.rmtree(root / "Sequence1/1x/rgbs/cam1")
    assert open_capture(root).takes[0].training_cameras == ("cam0", "cam2")
    scene_path = root / "Sequence1/scene.json"
    scene_path.write_text(json.dumps({"train_cameras": ["cam0", "cam1"]}))
    with pytest.raises(MissingInput, match="Camera cam1"):
        open_capture(root)
    scene_path.write_text(json.dumps({"train_cameras": ["cam0", "cam9"]}))
    with pytest.raises(BadData, match="cam9"):
        open_capture(root)

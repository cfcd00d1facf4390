"""One camera that is wrong, or masks that all are, is named with its cause."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stages.shared.capture import Camera, Take, native_writer, open_capture
from stages.shared.capture.alignment import check_alignment
from stages.shared.errors import BadData
from stages.shared.meshes.raycast import RayScene
from tests.shared.capture import scene

FRAMES, CHECKED = 16, 8
Change = Callable[[str, int, np.ndarray], np.ndarray]


def block(frame: int, scale: float = 1.0) -> trimesh.Trimesh:
    """Something that looks different from every side, and moves from frame to frame."""
    mesh = trimesh.creation.box(extents=np.array([0.30, 0.6, 0.12]) * scale)
    mesh.apply_translation(scene.CENTRE + [0.16, 0.05, 0.02 + 0.02 * (frame - CHECKED)])
    return mesh


@pytest.fixture(scope="module")
def masks() -> Mapping[tuple[str, int], np.ndarray]:
    found = {}
    for frame in range(FRAMES):
        mesh = block(frame)
        surface = RayScene(mesh.vertices, mesh.faces)
        for camera in scene.ring(8):
            found[camera.name, frame] = np.where(surface.render(camera).hit, 255, 0).astype(np.uint8)
    return found


def take_of(
    path: Path,
    masks: Mapping[tuple[str, int], np.ndarray],
    change: Change = lambda name, frame, mask: mask,
    labels: Change | None = None,
) -> Take:
    with native_writer(path, scene.ring(8)) as writer:
        take = writer.take("walk", "train", scene.poses(FRAMES))
        for (name, frame), mask in masks.items():
            image = np.zeros((*mask.shape, 3), np.uint8)
            ids = None if labels is None else labels(name, frame, mask)
            take.view(name, frame, image, change(name, frame, mask), ids, jpeg=False)
    return open_capture(path).takes[0]


def check(take: Take) -> tuple[str, ...]:
    mesh = block(CHECKED, 0.95)
    return check_alignment(take, {CHECKED: mesh.vertices}, mesh.faces).warnings


def with_cameras(take: Take, change: Callable[[dict[str, Camera]], None]) -> Take:
    cameras = dict(take.cameras)
    change(cameras)
    return dataclasses.replace(take, cameras=cameras)


def test_a_right_capture_is_not_warned_of(
    tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    take = take_of(
        tmp_path / "a", masks, labels=lambda name, frame, mask: np.where(mask > 0, 3, 255).astype(np.uint8)
    )
    assert check(take) == ()


@pytest.mark.parametrize(("first", "second"), [("cam1", "cam5"), ("cam2", "cam3"), ("cam0", "cam6")])
def test_exchanged_extrinsics_are_named(
    first: str, second: str, tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    def exchange(cameras: dict[str, Camera]) -> None:
        a, b = cameras[first], cameras[second]
        cameras[first] = dataclasses.replace(a, camera_from_world=b.camera_from_world)
        cameras[second] = dataclasses.replace(b, camera_from_world=a.camera_from_world)

    take = with_cameras(take_of(tmp_path / "a", masks), exchange)
    try:
        text = " ".join(check(take))
        assert first in text and second in text
    except BadData as refusal:
        text = refusal.what
    assert "extrinsics seem to be exchanged" in text and (first in text or second in text)


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.4])
def test_a_focal_length_that_is_off_is_named(
    factor: float, tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    def zoom(cameras: dict[str, Camera]) -> None:
        intrinsics = cameras["cam4"].intrinsics.copy()
        intrinsics[[0, 1], [0, 1]] *= factor
        cameras["cam4"] = dataclasses.replace(cameras["cam4"], intrinsics=intrinsics)

    take = with_cameras(take_of(tmp_path / "a", masks), zoom)
    try:
        text = " ".join(check(take))
    except BadData as refusal:
        text = refusal.what
    assert "cam4" in text.lower() and "focal length seems off" in text.lower()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda name, frame, mask: np.full_like(mask, 255) if name == "cam2" else mask, "white all over"),
        (lambda name, frame, mask: 255 - mask if name == "cam2" else mask, "inverted"),
    ],
)
def test_masks_of_one_camera_that_are_wrong_are_named(
    change: Change, words: str, tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    try:
        text = " ".join(check(take_of(tmp_path / "a", masks, change)))
    except BadData as refusal:
        text = refusal.what
    assert "cam2" in text.lower() and words in text


@pytest.mark.parametrize("shift", [-6, 5, 7])
def test_a_camera_that_is_some_frames_off_is_named(
    shift: int, tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    def late(name: str, frame: int, mask: np.ndarray) -> np.ndarray:
        other = min(max(frame - shift, 0), FRAMES - 1)
        return masks[name, other] if name == "cam2" else mask

    try:
        text = " ".join(check(take_of(tmp_path / "a", masks, late)))
    except BadData as refusal:
        text = refusal.what
    assert "cam2" in text.lower() and f"{abs(shift)} frames" in text


def test_inverted_masks_are_recognised(tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]) -> None:
    take = take_of(tmp_path / "a", masks, lambda name, frame, mask: 255 - mask)
    with pytest.raises(BadData, match="masks are inverted"):
        check(take)


def test_a_camera_that_sees_nobody_costs_its_view(
    tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]
) -> None:
    take = take_of(tmp_path / "a", masks, lambda name, frame, mask: mask * (name != "cam3"))
    assert "nobody is seen by cam3" in " ".join(check(take))
    empty = take_of(tmp_path / "b", masks, lambda name, frame, mask: 0 * mask)
    with pytest.raises(BadData, match="mask is empty"):
        check(empty)


def test_labels_are_compared_with_masks(tmp_path: Path, masks: Mapping[tuple[str, int], np.ndarray]) -> None:
    def zero_outside(name: str, frame: int, mask: np.ndarray) -> np.ndarray:
        return np.where(mask > 0, 3, 0).astype(np.uint8)

    text = " ".join(check(take_of(tmp_path / "a", masks, labels=zero_outside)))
    assert "label images mark pixels outside the masks" in text and "255" in text

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from stages.shared.body import load_body, posed_vertices
from stages.shared.capture import Camera, Take, open_capture
from stages.shared.capture.alignment import check_alignment, overlay_picture
from stages.shared.capture.convention import CONVENTIONS, take_in_convention
from stages.shared.errors import BadData, UsageProblem
from tests.shared.capture import scene

AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# How captures write `camera_from_world`, given the true one; independent of the table in the code.
WRITTEN = {
    "as is": lambda m: m,
    "rows 0 and 1 negated": lambda m: AXES @ m,
    "rows 1 and 2 negated": lambda m: FLIP @ m,
    "inverted": np.linalg.inv,
    "inverted, rows 0 and 1 negated": lambda m: np.linalg.inv(AXES @ m),
    "inverted, rows 1 and 2 negated": lambda m: np.linalg.inv(FLIP @ m),
}


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Take:
    return open_capture(scene.write_native(tmp_path_factory.mktemp("alignment") / "ball", frames=1)).takes[0]


@pytest.fixture(scope="module")
def body() -> trimesh.Trimesh:
    """A part of the ball off its axis, so that no turn of it fits the masks."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.25)
    mesh.apply_translation(scene.CENTRE + [0.06, 0.1, 0.03])
    return mesh


def change(take: Take, how) -> Take:  # type: ignore[no-untyped-def]
    cameras: dict[str, Camera] = {
        name: dataclasses.replace(camera, camera_from_world=how(camera.camera_from_world))
        for name, camera in take.cameras.items()
    }
    return dataclasses.replace(take, cameras=cameras)


def test_a_right_capture_passes_as_it_is(take: Take, body: trimesh.Trimesh) -> None:
    found = check_alignment(take, {0: body.vertices}, body.faces)
    assert found.convention == "as is" and found.mean_inside == 1.0
    assert set(found.inside) == {"cam0", "cam1", "cam2"}
    assert all(0.2 < share < 0.8 for share in found.covered.values())


@pytest.mark.parametrize("written", WRITTEN)
def test_other_conventions_are_recognised(take: Take, body: trimesh.Trimesh, written: str) -> None:
    other = change(take, WRITTEN[written])
    found = check_alignment(other, {0: body.vertices}, body.faces)
    assert found.mean_inside == 1.0
    mended = take_in_convention(other, found.convention)
    for name, camera in take.cameras.items():
        pixels = camera.project(body.vertices)[0]
        if found.convention == written:
            np.testing.assert_allclose(mended.cameras[name].project(body.vertices)[0], pixels, atol=1e-9)
    assert set(WRITTEN) == set(CONVENTIONS)


def test_what_fits_in_no_convention_is_refused_with_all_that_was_tried(
    take: Take, body: trimesh.Trimesh
) -> None:
    with pytest.raises(BadData) as caught:
        check_alignment(take, {0: body.vertices + [0.6, 0, 0]}, body.faces)
    assert caught.value.exit_code == 65
    assert all(name in caught.value.where for name in CONVENTIONS)


def test_millimetres_are_refused(take: Take, body: trimesh.Trimesh) -> None:
    """A body of a small part of its size lies inside every mask; it covers next to nothing of them."""
    tiny = scene.CENTRE + (body.vertices - scene.CENTRE) / 4
    with pytest.raises(BadData, match="covers only") as caught:
        check_alignment(take, {0: tiny}, body.faces)
    assert "metres" in caught.value.fix


def test_one_wrong_camera_is_named(take: Take, body: trimesh.Trimesh) -> None:
    cameras = dict(take.cameras)
    moved = cameras["cam1"].camera_from_world.copy()
    moved[0, 3] += 0.45
    cameras["cam1"] = dataclasses.replace(cameras["cam1"], camera_from_world=moved)
    with pytest.raises(BadData):
        check_alignment(dataclasses.replace(take, cameras=cameras), {0: body.vertices}, body.faces)
    with pytest.raises(BadData, match="Camera cam1"):
        check_alignment(dataclasses.replace(take, cameras=cameras), {0: body.vertices}, body.faces, bar=0.6)


def test_overlay_shows_every_training_camera(take: Take, body: trimesh.Trimesh) -> None:
    sheet = overlay_picture(take, 0, body.vertices, body.faces, {"cam0": 1.0})
    assert sheet.dtype == np.uint8 and sheet.shape == (320, 3 * 320, 3)
    magenta = (sheet == (255, 0, 200)).all(axis=-1)
    assert all(magenta[:, 320 * view : 320 * (view + 1)].sum() > 50 for view in range(3))


def test_unknown_convention_is_refused(take: Take) -> None:
    with pytest.raises(UsageProblem):
        take_in_convention(take, "upside down")


def test_the_convention_of_a_real_capture_is_found(subject_a: Path, shared_folder: Path) -> None:
    take = open_capture(subject_a).takes[0]
    model = load_body(shared_folder / "body" / "anny_smplx_format.npz")
    vertices = {
        frame: posed_vertices(
            model,
            torch.from_numpy(take.poses.rotations[frame]),
            torch.from_numpy(take.poses.translation[frame]),
            torch.from_numpy(take.poses.betas),
        ).numpy()
        for frame in (120,)
    }
    for written in ("as is", "rows 0 and 1 negated", "inverted, rows 1 and 2 negated"):
        found = check_alignment(change(take, WRITTEN[written]), vertices, model.faces)
        assert found.convention == written
        assert found.mean_inside > 0.99

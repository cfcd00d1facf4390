"""Pictures and videos of a ball by cameras with lenses, imported: what users have, with its usual defects."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from stages.import_capture.config import ImportConfig
from stages.import_capture.media import Recording, by_camera, frame_table
from stages.import_capture.pictures import read_picture
from stages.import_capture.refine import refined_cameras
from stages.import_capture.stage import plan, run
from stages.import_capture.videos import frame_times, read_frames, upright
from stages.import_capture.world import stature
from stages.shared.capture import Camera, open_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from tests.listening import Listener
from tests.shared.capture import scene

SIDE = (256, 192)


@pytest.fixture(autouse=True)
def without_networks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Tests are the same where the extra is installed."""
    monkeypatch.setenv("GW_VISION_MODELS", str(tmp_path / "nowhere"))


def cameras(count: int = 4) -> list[Camera]:
    return scene.ring(count, *SIDE, 280.0)


def calibration(
    path: Path, given: list[Camera], distortion: tuple[float, ...] = (), unit: float = 1.0
) -> None:
    content = {
        camera.name: {
            "K": (camera.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).tolist(),
            "R": camera.camera_from_world[:3, :3].tolist(),
            "T": (camera.camera_from_world[:3, 3] / unit).tolist(),
            "distCoeff": list(distortion),
            "imgSize": [camera.width, camera.height],
        }
        for camera in given
    }
    path.write_text(json.dumps(content))


def seen_through_lens(camera: Camera, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Picture and mask of the ball by a camera with a lens: every pixel's ray, straightened by OpenCV."""
    grid = np.stack(np.meshgrid(np.arange(SIDE[0]), np.arange(SIDE[1])), axis=-1).reshape(-1, 1, 2)
    matrix = camera.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    straight = cv2.undistortPoints(grid.astype(np.float64), matrix, np.array(distortion), P=matrix)
    image, mask = scene.picture(camera)[:2]
    columns, rows = straight.reshape(SIDE[1], SIDE[0], 2).transpose(2, 0, 1).astype(np.float32)
    warped = [cv2.remap(part, columns, rows, cv2.INTER_LINEAR) for part in (image, mask)]
    return warped[0], warped[1]


def write_pictures(root: Path, distortion: tuple[float, ...] = (), alpha: bool = True) -> list[Camera]:
    given = cameras()
    for camera in given:
        image, mask = seen_through_lens(camera, distortion) if distortion else scene.picture(camera)[:2]
        folder = root / camera.name
        folder.mkdir(parents=True)
        picture = np.dstack([image[..., ::-1], mask]) if alpha else image[..., ::-1]
        cv2.imwrite(str(folder / "frame_0001.png"), picture)
    calibration(root / "calibration.json", given, distortion)
    return given


def test_pictures_with_alpha_through_lenses(tmp_path: Path) -> None:
    """The imported masks are those of the straight cameras: distortion is gone, alpha is the mask."""
    write_pictures(tmp_path / "source", (-0.25, 0.06, 0.002, -0.001))
    heard = Listener()
    result = run(tmp_path / "source", tmp_path / "capture", ImportConfig(held_out=("cam3",)), heard)
    assert result.summary["masks"] == "alpha" and result.summary["cameras"] == 4
    assert any("undistorted" in text for text in heard.said)
    take = open_capture(tmp_path / "capture", poses_needed=False).takes[0]
    assert take.heldout_cameras == ("cam3",) and take.frames == [0]
    for name, camera in take.cameras.items():
        truth = scene.picture(camera)[1] > 127
        mask = take.mask(name, 0) > 127
        assert (mask & truth).sum() / (mask | truth).sum() > 0.98
        assert np.abs(take.image(name, 0)[truth].astype(int) - scene.picture(camera)[0][truth]).mean() < 3
    assert (tmp_path / "capture" / "contact_sheet.png").is_file()


def test_other_units_and_another_axis_up(tmp_path: Path) -> None:
    given = write_pictures(tmp_path / "source")
    calibration(tmp_path / "source" / "calibration.json", given, unit=0.001)
    config = ImportConfig(up="+x", metres_per_unit=0.001)
    run(tmp_path / "source", tmp_path / "capture", config)
    take = open_capture(tmp_path / "capture", poses_needed=False).takes[0]
    for camera in given:
        centre = take.cameras[camera.name].centre
        assert centre[1] == pytest.approx(camera.centre[0])  # what was x is y
        assert np.linalg.norm(centre) == pytest.approx(np.linalg.norm(camera.centre))
        pixel = take.cameras[camera.name].project([-scene.CENTRE[1], scene.CENTRE[0], scene.CENTRE[2]])[0]
        np.testing.assert_allclose(pixel, camera.project(scene.CENTRE)[0], atol=1e-6)
    with pytest.raises(BadData, match="unit of the calibration"):
        run(tmp_path / "source", tmp_path / "other", ImportConfig())
    assert not (tmp_path / "other").exists()


def test_without_masks_the_message_says_which_sources_are_left(tmp_path: Path) -> None:
    write_pictures(tmp_path / "source", alpha=False)
    with pytest.raises(MissingInput, match="nothing to make masks from") as problem:
        run(tmp_path / "source", tmp_path / "capture")
    for source in ("masks/", "alpha", "--background", "vision"):
        assert source in problem.value.fix
    assert not (tmp_path / "capture").exists()


def test_a_picture_of_the_empty_scene(tmp_path: Path) -> None:
    given = write_pictures(tmp_path / "source", alpha=False)
    for camera in given:
        folder = tmp_path / "empty" / camera.name
        folder.mkdir(parents=True)
        empty = np.full((SIDE[1], SIDE[0], 3), int(scene.picture(camera)[0][0, 0, 0]), np.uint8)
        cv2.imwrite(str(folder / "empty.png"), empty)
    run(tmp_path / "source", tmp_path / "capture", ImportConfig(background=tmp_path / "empty"))
    take = open_capture(tmp_path / "capture", poses_needed=False).takes[0]
    for name, camera in take.cameras.items():
        truth, mask = scene.picture(camera)[1] > 127, take.mask(name, 0) > 127
        assert (mask & truth).sum() / (mask | truth).sum() > 0.93


def test_sizes_orders_and_names_that_do_not_agree(tmp_path: Path) -> None:
    source = tmp_path / "source"
    given = write_pictures(source)
    turned = [Camera(c.name, c.height, c.width, c.intrinsics, c.camera_from_world) for c in given]
    calibration(source / "calibration.json", turned)
    with pytest.raises(BadData, match="turned by a quarter"):
        plan(source, tmp_path / "capture")
    calibration(source / "calibration.json", given)
    with pytest.raises(UsageProblem, match="no camera 'cam9'"):
        plan(source, tmp_path / "capture", ImportConfig(held_out=("cam9",)))
    with pytest.raises(MissingInput, match="no calibration"):
        (source / "calibration.json").unlink()
        plan(source, tmp_path / "capture")


def test_black_bars_above_and_below_belong_to_no_camera(tmp_path: Path) -> None:
    source = tmp_path / "source"
    given = write_pictures(source)
    for camera in given:
        path = source / camera.name / "frame_0001.png"
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), cv2.copyMakeBorder(picture, 9, 9, 0, 0, cv2.BORDER_CONSTANT))
    run(source, tmp_path / "capture")
    take = open_capture(tmp_path / "capture", poses_needed=False).takes[0]
    for camera in given:
        barred = take.cameras[camera.name]
        np.testing.assert_allclose(barred.project(scene.CENTRE)[0], camera.project(scene.CENTRE)[0] + [0, 9])


def jpeg(path: Path, picture: np.ndarray, orientation: int) -> None:
    """A JPEG with an EXIF block that holds the orientation alone."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + b"\0" * 4
    block = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + data[2:])


def test_phones_turn_pictures_by_a_flag(tmp_path: Path) -> None:
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:20, :30] = (0, 0, 255)
    jpeg(tmp_path / "one.jpg", picture, 6)  # turn right by a quarter to see it upright
    image, alpha = read_picture(tmp_path / "one.jpg")
    assert image.shape == (60, 40, 3) and alpha is None
    assert image[5, 35, 0] > 200 and image[5, 5, 0] < 60


@pytest.mark.parametrize("kind", ["16 bit", "grey", "16 bit grey"])
def test_depths_and_grey(kind: str, tmp_path: Path) -> None:
    ramp = np.linspace(0, 1, 64)[None].repeat(8, axis=0)
    colour = ramp if "grey" in kind else np.dstack([ramp, ramp, ramp])
    scaled = np.rint(colour * (65535 if "16" in kind else 255)).astype(
        np.uint16 if "16" in kind else np.uint8
    )
    cv2.imwrite(str(tmp_path / "a.png"), scaled)
    image, _ = read_picture(tmp_path / "a.png")
    assert image.shape == (8, 64, 3) and image.dtype == np.uint8
    assert np.abs(image[0, :, 1] - 255 * ramp[0]).max() <= 1


def test_cmyk_is_refused_by_name(tmp_path: Path) -> None:
    frame = b"\xff\xc0\x00\x14\x08\x00\x08\x00\x08\x04" + bytes(range(12))
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8" + frame + b"\xff\xd9")
    with pytest.raises(BadData, match="CMYK"):
        read_picture(tmp_path / "a.jpg")
    (tmp_path / "b.png").write_bytes(b"nothing")
    with pytest.raises(BadData, match="cannot be decoded"):
        read_picture(tmp_path / "b.png")


def write_video(path: Path, times: list[float], size: tuple[int, int] = (64, 48)) -> None:
    """Frames at any times; the grey level of each is its number times ten."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264rgb" if path.suffix == ".mkv" else "mpeg4", rate=30)
        stream.width, stream.height = size
        stream.pix_fmt = "rgb24" if path.suffix == ".mkv" else "yuv420p"
        stream.time_base = Fraction(1, 1000)
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, time in enumerate(times):
            picture = np.full((size[1], size[0], 3), 10 * number + 20, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)


def test_frames_of_a_video_whose_rate_varies(tmp_path: Path) -> None:
    times = [0.0, 0.1, 0.2, 0.45, 0.5, 0.6]
    write_video(tmp_path / "a.mp4", times)
    np.testing.assert_allclose(frame_times(tmp_path / "a.mp4"), times, atol=2e-3)
    frames = dict(read_frames(tmp_path / "a.mp4", {1: [0], 3: [1, 2]}))
    assert [round((int(frames[row][20, 20, 0]) - 20) / 10) for row in (0, 1, 2)] == [1, 3, 3]
    with pytest.raises(BadData, match="ends before frame 9"):
        list(read_frames(tmp_path / "a.mp4", {9: [0]}))
    (tmp_path / "b.mp4").write_bytes(b"no video at all")
    with pytest.raises(BadData, match="cannot be read"):
        frame_times(tmp_path / "b.mp4")


def test_rotation_flags() -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    np.testing.assert_array_equal(upright(picture, 90), np.rot90(picture))
    np.testing.assert_array_equal(upright(picture, -90), np.rot90(picture, 3))
    np.testing.assert_array_equal(upright(picture, 0), picture)


def test_cameras_that_began_at_different_times() -> None:
    """Rows are equal instants: the camera that began 0.2 s later shows an earlier frame number in each."""
    video = Path("a.mp4")
    recordings = {
        "a": Recording("a", video, (), np.arange(30) / 30),
        "b": Recording("b", video, (), np.arange(60) / 60),
    }
    fps, table = frame_table(recordings, None, {"b": 0.2}, (0, None, 1))
    assert fps == pytest.approx(45)
    fps, table = frame_table(recordings, 30.0, {"b": 0.2}, (0, None, 2))
    assert fps == 15
    assert table["a"][:3] == [6, 8, 10] and table["b"][:3] == [0, 4, 8]
    assert len(table["a"]) == len(table["b"]) == 12


def test_recordings_and_cameras_find_each_other() -> None:
    one = Recording("x", Path("x.mp4"), (), np.zeros(1))

    def named(*names: str) -> list[Recording]:
        return [Recording(name, one.video, (), one.times) for name in names]

    assigned, notes = by_camera(named("shot_5_00020", "shot_10_00020"), ["5", "10", "11"])
    assert assigned["5"].name == "shot_5_00020" and assigned["10"].name == "shot_10_00020"
    assert notes == ["cameras without a recording are left out: 11"]
    assigned, notes = by_camera(named("front", "rear"), ["1", "2"])
    assert assigned["1"].name == "front" and "alphabetical" in notes[0]
    with pytest.raises(MissingInput, match="No recording"):
        by_camera(named("front"), ["1", "2"])


def test_a_camera_two_centimetres_off_is_brought_back() -> None:
    given = cameras(6)
    random = np.random.default_rng(0)
    points = scene.CENTRE + random.uniform(-0.4, 0.4, (20, 33, 3))
    pixels = np.stack([camera.project(points)[0] for camera in given])
    pose = given[2].camera_from_world.copy()
    pose[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.01, 0.0]))[0] @ pose[:3, :3]
    pose[:3, 3] += [0.02, 0.0, -0.02]
    wrong = [*given]
    wrong[2] = Camera(given[2].name, *SIDE, given[2].intrinsics, pose)
    refined = refined_cameras(wrong, pixels, np.ones(pixels.shape[:3]))

    def error(some: list[Camera]) -> float:
        again = np.stack([camera.project(points)[0] for camera in some])
        return float(np.linalg.norm(again - pixels, axis=-1)[2].mean())

    assert error(wrong) > 2
    from stages.shared.vision.triangulate import triangulate

    after = triangulate(refined, pixels, np.ones(pixels.shape[:3]))
    assert np.nanmedian(after.pixels) < 0.3


def test_stature_of_a_figure() -> None:
    points = np.full((1, 33, 3), np.nan)
    for rows, height in (([0], 1.55), ([11, 12], 1.40), ([23, 24], 0.90), ([25, 26], 0.50), ([27, 28], 0.08)):
        points[0, rows] = [0, height, 0]
    assert stature(points) == pytest.approx(1.47 / 0.876)

"""The same two cameras written as every tool writes them, and the pictures of a lens made straight."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.shared.calibration.model import LensCamera, lens_camera
from stages.shared.calibration.read import find_calibration, read_calibration
from stages.shared.calibration.undistort import undistortion
from stages.shared.errors import BadData, MissingInput

SIZE = (640, 480)
DISTORTION = (-0.12, 0.05, 0.002, -0.001)
CENTRES = {"left": (1.0, -2.0, 1.5), "right": (-1.5, 2.0, 1.0)}


def rotation(name: str) -> np.ndarray:
    vector = (0.3, -0.4, 0.2) if name == "left" else (-0.2, 2.5, 0.3)
    return np.asarray(cv2.Rodrigues(np.array(vector))[0])


def intrinsics(name: str) -> np.ndarray:
    shift = 3.0 if name == "left" else -5.0
    return np.array([[800.0, 0, 320 + shift], [0, 805.0, 240 - shift], [0, 0, 1]])


def translation(name: str) -> np.ndarray:
    return np.asarray(-rotation(name) @ np.array(CENTRES[name]))


def quaternion(matrix: np.ndarray) -> list[float]:
    w = np.sqrt(1 + np.trace(matrix)) / 2
    x, y, z = (matrix[[2, 0, 1], [1, 2, 0]] - matrix[[1, 2, 0], [2, 0, 1]]) / (4 * w)
    return [float(value) for value in (w, x, y, z)]


def write_colmap_text(folder: Path, model: str = "OPENCV", values: tuple[float, ...] = DISTORTION) -> Path:
    cameras, images = ["# comment"], ["# comment"]
    for number, name in enumerate(CENTRES, start=1):
        k = intrinsics(name)
        lens = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *values]
        cameras.append(f"{number} {model} {SIZE[0]} {SIZE[1]} " + " ".join(map(str, lens)))
        pose = [*quaternion(rotation(name)), *translation(name)]
        images += [f"{number} " + " ".join(map(str, pose)) + f" {number} {name}.jpg", "1.0 2.0 -1"]
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    return folder


def write_colmap_binary(folder: Path) -> Path:
    cameras, images = struct.pack("<Q", 2), struct.pack("<Q", 2)
    for number, name in enumerate(CENTRES, start=1):
        k = intrinsics(name)
        lens = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *DISTORTION)
        cameras += struct.pack("<iiQQ8d", number, 4, *SIZE, *lens)
        images += struct.pack("<i7di", number, *quaternion(rotation(name)), *translation(name), number)
        images += f"{name}.jpg".encode() + b"\0" + struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
    folder.mkdir()
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(images)
    return folder


def write_easymocap(folder: Path) -> Path:
    folder.mkdir()
    inner = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    outer = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (inner, outer):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in CENTRES:
            storage.write("", name)
        storage.endWriteStruct()
    for name in CENTRES:
        inner.write(f"K_{name}", intrinsics(name))
        inner.write(f"dist_{name}", np.array([[*DISTORTION, 0.0]]))
        inner.write(f"W_{name}", SIZE[0])
        inner.write(f"H_{name}", SIZE[1])
        outer.write(f"R_{name}", cv2.Rodrigues(rotation(name))[0])
        outer.write(f"Rot_{name}", rotation(name))
        outer.write(f"T_{name}", translation(name).reshape(3, 1))
    inner.release()
    outer.release()
    return folder


def write_opencv(folder: Path) -> Path:
    folder.mkdir()
    for name in CENTRES:
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", SIZE[0])
        storage.write("image_height", SIZE[1])
        storage.write("camera_matrix", intrinsics(name))
        storage.write("distortion_coefficients", np.array(DISTORTION).reshape(4, 1))
        storage.write("R", rotation(name))
        storage.write("T", translation(name).reshape(3, 1))
        storage.release()
    return folder


def write_nerfstudio(folder: Path) -> Path:
    frames = []
    for name in CENTRES:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(name).T * [1, -1, -1], CENTRES[name]
        k = intrinsics(name)
        frames.append(
            {"file_path": f"images/{name}.jpg", "transform_matrix": pose.tolist(), "fl_x": k[0, 0],
             "fl_y": k[1, 1], "cx": k[0, 2] + 0.5, "cy": k[1, 2] + 0.5}
        )  # fmt: skip
    lens = dict(zip(("k1", "k2", "p1", "p2"), DISTORTION, strict=True))
    folder.mkdir()
    path = folder / "transforms.json"
    path.write_text(
        json.dumps({"camera_model": "OPENCV", "w": SIZE[0], "h": SIZE[1], **lens, "frames": frames})
    )
    return path


def write_avatarrex(folder: Path) -> Path:
    content: dict[str, Any] = {
        name: {"K": intrinsics(name).reshape(-1).tolist(), "R": rotation(name).reshape(-1).tolist(),
               "T": translation(name).tolist(), "distCoeff": [*DISTORTION, 0.0], "imgSize": list(SIZE)}
        for name in CENTRES
    }  # fmt: skip
    folder.mkdir()
    path = folder / "calibration_full.json"
    path.write_text(json.dumps(content))
    return path


def write_qualisys(folder: Path) -> Path:
    cameras = []
    for name in CENTRES:
        k, turn = intrinsics(name), np.diag([1, -1, -1]) @ rotation(name)
        rows = " ".join(f'r{i + 1}{j + 1}="{turn[i, j]!r}"' for i in range(3) for j in range(3))
        rows = rows.replace("np.float64(", "").replace(")", "")
        x, y, z = (1000 * value for value in CENTRES[name])
        cameras.append(
            f'<camera active="1" serial="{name}" viewrotation="0">'
            f'<fov_video_max left="0" top="0" right="{SIZE[0] - 1}" bottom="{SIZE[1] - 1}"/>'
            f'<transform x="{x}" y="{y}" z="{z}" {rows}/>'
            f'<intrinsic focalLengthU="{64 * k[0, 0]}" focalLengthV="{64 * k[1, 1]}" '
            f'centerPointU="{64 * k[0, 2]}" centerPointV="{64 * k[1, 2]}" '
            f'radialDistortion1="{DISTORTION[0]}" '
            f'radialDistortion2="{DISTORTION[1]}" tangentalDistortion1="{DISTORTION[2]}" '
            f'tangentalDistortion2="{DISTORTION[3]}"/></camera>'
        )
    folder.mkdir()
    path = folder / "walk.qca.txt"
    path.write_text(f"<calibration><cameras>{''.join(cameras)}</cameras></calibration>")
    return path


def write_table(folder: Path) -> Path:
    lines = []
    for name in CENTRES:
        pose = np.c_[rotation(name), translation(name)]
        lines += [name, *(" ".join(map(str, row)) for row in intrinsics(name))]
        lines += [" ".join(map(str, DISTORTION)), *(" ".join(map(str, row)) for row in pose), ""]
    folder.mkdir()
    path = folder / "calibration.txt"
    path.write_text("\n".join(lines))
    return path


WRITERS = {
    "colmap text": write_colmap_text,
    "colmap binary": write_colmap_binary,
    "easymocap": write_easymocap,
    "opencv": write_opencv,
    "nerfstudio": write_nerfstudio,
    "avatarrex": write_avatarrex,
    "qualisys": write_qualisys,
    "table": write_table,
}


@pytest.mark.parametrize("kind", list(WRITERS))
def test_every_tool_gives_the_same_cameras(kind: str, tmp_path: Path) -> None:
    path = WRITERS[kind](tmp_path / "calibration")
    calibration = read_calibration(path)
    unit = 1000.0 if kind == "qualisys" else 1.0
    assert list(calibration.cameras) == list(CENTRES)
    for name, camera in calibration.cameras.items():
        expected = intrinsics(name) + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        np.testing.assert_allclose(camera.intrinsics, expected, atol=1e-9)
        np.testing.assert_allclose(camera.distortion[:4], DISTORTION)
        np.testing.assert_allclose(camera.camera_from_world[:3, :3], rotation(name), atol=1e-9)
        np.testing.assert_allclose(camera.centre, unit * np.array(CENTRES[name]), atol=1e-6)
        assert camera.size == (None if kind == "table" else SIZE) and not camera.fisheye
    assert (calibration.metres_per_unit, calibration.up is not None) == (
        (0.001, True) if kind == "qualisys" else (None, False)
    )


def test_a_calibration_is_found_beside_the_pictures(tmp_path: Path) -> None:
    write_avatarrex(tmp_path / "one")
    assert find_calibration(tmp_path / "one") == tmp_path / "one" / "calibration_full.json"
    write_colmap_text(tmp_path / "two")
    (tmp_path / "two" / "images").mkdir()
    assert find_calibration(tmp_path / "two" / "images") == tmp_path / "two"
    (tmp_path / "three").mkdir()
    (tmp_path / "three" / "notes.md").write_text("nothing")
    with pytest.raises(MissingInput, match="No calibration"):
        read_calibration(tmp_path / "three")


def test_lens_models_of_colmap(tmp_path: Path) -> None:
    fisheye = read_calibration(write_colmap_text(tmp_path / "a", "OPENCV_FISHEYE", (0.1, 0.02, 0.003, 0.0)))
    assert fisheye.cameras["left"].fisheye
    plain = read_calibration(write_colmap_text(tmp_path / "b", "PINHOLE", ()))
    assert len(plain.cameras["left"].distortion) == 0
    with pytest.raises(BadData, match="FOV"):
        read_calibration(write_colmap_text(tmp_path / "c", "FOV", (0.9,)))
    data = write_colmap_binary(tmp_path / "d") / "images.bin"
    data.write_bytes(data.read_bytes()[:-40])
    with pytest.raises(BadData, match="damaged"):
        read_calibration(data.parent)


@pytest.mark.parametrize(
    ("change", "message"),
    [("R", "no rotation"), ("K", "focal length"), ("T", "wrong shape"), ("distCoeff", "distortion")],
)
def test_numbers_that_cannot_be_meant(change: str, message: str, tmp_path: Path) -> None:
    path = write_avatarrex(tmp_path / "calibration")
    content = json.loads(path.read_text())
    values = content["right"]
    values[change] = {"R": np.full(9, 0.3).tolist(), "K": [-1.0] * 9, "T": [1.0], "distCoeff": [0.1] * 13}[
        change
    ]
    path.write_text(json.dumps(content))
    with pytest.raises(BadData, match=message):
        read_calibration(path)


def lens(distortion: tuple[float, ...], fisheye: bool = False, skew: float = 0.0) -> LensCamera:
    matrix = intrinsics("left")
    matrix[0, 1] = skew
    pose = np.c_[rotation("left"), translation("left")]
    return lens_camera("left", SIZE, matrix, pose, "test", distortion, fisheye)


@pytest.mark.parametrize(
    ("distortion", "fisheye", "skew"),
    [(DISTORTION, False, 0.0), ((*DISTORTION, 0.03, 0.01, -0.02, 0.004), False, 0.0),
     ((-0.04, 0.06), False, -1.5), ((0.08, -0.02, 0.005, 0.0), True, 0.0)],
)  # fmt: skip
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_a_point_is_where_the_lens_says(
    distortion: tuple[float, ...], fisheye: bool, skew: float, alpha: float
) -> None:
    """The map at a pinhole's pixel is where OpenCV projects the same point through the lens."""
    camera = lens(distortion, fisheye, skew)
    straight = undistortion(camera, alpha)
    assert straight.columns is not None and straight.rows is not None
    random = np.random.default_rng(0)
    in_camera = np.c_[random.uniform(-0.3, 0.3, (40, 2)), np.ones(40)] * 2.5
    world = (in_camera - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]
    pixels = straight.camera.project(world)[0] - 0.5
    inside = ((pixels > 1) & (pixels < np.array(SIZE) - 2)).all(axis=1)
    assert inside.sum() > 10
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    matrix = camera.intrinsics.copy()
    matrix[:2, 2] -= 0.5
    none = np.zeros(3)
    upright = matrix.copy()
    upright[0, 1] = 0
    seen = project(in_camera[:, None], none, none, upright, camera.distortion)[0].reshape(-1, 2)
    seen[:, 0] += skew * (seen[:, 1] - matrix[1, 2]) / matrix[1, 1]
    mapped = [
        cv2.remap(part, *pixels[inside].T.astype(np.float32), cv2.INTER_LINEAR).reshape(-1)
        for part in (straight.columns, straight.rows)
    ]
    np.testing.assert_allclose(np.stack(mapped, axis=1), seen[inside], atol=0.05)


def test_a_pinhole_is_left_as_it_is() -> None:
    straight = undistortion(lens(()))
    picture = np.arange(SIZE[0] * SIZE[1] * 3, dtype=np.uint8).reshape(SIZE[1], SIZE[0], 3)
    assert straight.columns is None and straight.picture(picture) is picture


def test_pictures_of_another_size() -> None:
    camera = lens(DISTORTION)
    half = camera.resized(320, 244, bars=2)
    np.testing.assert_allclose(half.intrinsics[0], camera.intrinsics[0] / 2)
    np.testing.assert_allclose(half.intrinsics[1, 2], camera.intrinsics[1, 2] / 2 + 2)
    with pytest.raises(BadData, match="another shape"):
        camera.resized(300, 240)

"""Captures as other programs leave them: camera fields, orientation, alpha, 16 bits, endings, lists."""

from __future__ import annotations

import codecs
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.shared.capture import open_capture
from stages.shared.capture.images import read_image, read_mask
from stages.shared.capture.labels import read_labels
from stages.shared.errors import BadData, GwError
from tests.shared.capture import scene

RANDOM = np.random.default_rng(1)
PICTURE = cv2.GaussianBlur(RANDOM.integers(0, 255, (64, 96, 3), np.uint8), (0, 0), 3)
MASK = np.zeros((16, 24), np.uint8)
MASK[4:12, 5:20] = 255


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write_native(tmp_path_factory.mktemp("good") / "ball")


def cameras(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(root: Path) -> None:
        content = json.loads((root / "cameras.json").read_text())
        change(content["cameras"][1])
        (root / "cameras.json").write_text(json.dumps(content))

    return edit


def takes(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(root: Path) -> None:
        content = json.loads((root / "capture.json").read_text())
        change(content)
        (root / "capture.json").write_text(json.dumps(content))

    return edit


_REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "distortion": (cameras(lambda c: c.update(distortion=[-0.4, 0.2, 0, 0, 0.1])), "lens distortion"),
    "dist_coeffs": (cameras(lambda c: c.update(dist_coeffs=[[0.01]])), "lens distortion"),
    "k1": (cameras(lambda c: c.update(k1=-0.1)), "lens distortion"),
    "distortion as text": (cameras(lambda c: c.update(distortion="-0.1")), "lens distortion"),
    "unknown field": (cameras(lambda c: c.update(rolling_shutter=3)), "'rolling_shutter'"),
    "skew": (cameras(lambda c: c["intrinsics"][0].__setitem__(1, 4.0)), "skew"),
    "skew below": (cameras(lambda c: c["intrinsics"][1].__setitem__(0, -2.0)), "skew"),
    "last row": (cameras(lambda c: c["camera_from_world"].__setitem__(3, [1, 2, 3, 0])), "0 0 0 1"),
    "last row scaled": (cameras(lambda c: c["camera_from_world"].__setitem__(3, [0, 0, 0, 2])), "0 0 0 1"),
    "fractional width": (cameras(lambda c: c.update(width=63.9)), "63.9"),
    "text as height": (cameras(lambda c: c.update(height="48")), "'48'"),
    "truth value as width": (cameras(lambda c: c.update(width=True)), "True"),
    "held_out as text": (cameras(lambda c: c.update(held_out="false")), "held_out"),
    "held_out as number": (cameras(lambda c: c.update(held_out=0)), "held_out"),
    "text in intrinsics": (cameras(lambda c: c["intrinsics"][0].__setitem__(0, "70")), "numbers"),
    "truth value in a matrix": (cameras(lambda c: c["camera_from_world"][0].__setitem__(0, True)), "numbers"),
    "ragged matrix": (cameras(lambda c: c["intrinsics"][0].pop()), "shape"),
    "take twice": (takes(lambda c: c["takes"].append(c["takes"][0])), "Two takes are called 'walk'"),
    "unknown field of a take": (takes(lambda c: c["takes"][0].update(offset=3)), "'offset'"),
    "unknown field of the capture": (takes(lambda c: c.update(scale=0.001)), "'scale'"),
    "frame rate as truth value": (takes(lambda c: c["takes"][0].update(fps=True)), "fps"),
    "scan frame in fractions": (takes(lambda c: c["takes"][0].update(scan_frame=0.5)), "scan_frame"),
    "name twice in an object": (
        lambda r: (r / "cameras.json").write_text(
            (r / "cameras.json").read_text().replace('"width": 64', '"width": 64, "width": 65', 1)
        ),
        "stands twice",
    ),
}


@pytest.mark.parametrize("name", _REFUSED)
def test_fields_that_are_not_read_are_refused(name: str, good: Path, tmp_path: Path) -> None:
    change, message = _REFUSED[name]
    root = scene.copy(good, tmp_path / "ball")
    change(root)
    with pytest.raises(BadData) as refusal:
        open_capture(root)
    assert message in refusal.value.what


@pytest.mark.parametrize(
    "change",
    [
        cameras(lambda c: c.update(distortion=[0, 0, 0, 0, 0])),
        cameras(lambda c: c.update(distortion=None)),
        cameras(lambda c: c.update(width=64.0)),
        cameras(lambda c: c["intrinsics"][0].__setitem__(1, 1e-6)),
        takes(lambda c: c.update(about={"by": "me"})),
        lambda r: (r / "cameras.json").write_bytes(codecs.BOM_UTF8 + (r / "cameras.json").read_bytes()),
    ],
)
def test_fields_that_change_nothing_are_read(
    change: Callable[[Path], None], good: Path, tmp_path: Path
) -> None:
    root = scene.copy(good, tmp_path / "ball")
    change(root)
    plain, other = open_capture(good).takes[0], open_capture(root).takes[0]
    for name, camera in plain.cameras.items():
        assert np.array_equal(camera.intrinsics, other.cameras[name].intrinsics)
        assert (camera.width, camera.height) == (other.cameras[name].width, other.cameras[name].height)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("distCoeff", [-0.35, 0.1, 0, 0, 0], "lens distortion"),
        ("rectifyAlpha", 0.5, "lens distortion"),
        ("offset", [1, 2], "'offset'"),
        ("imgSize", [64.5, 48], "64.5"),
        ("K", [70, 3, 32, 0, 70, 24, 0, 0, 1], "skew"),
    ],
)
@pytest.mark.parametrize("layout", ["thuman4", "avatarrex"])
def test_calibration_json_is_as_strict(
    layout: str, field: str, value: Any, message: str, tmp_path: Path
) -> None:
    root = scene.write_animatable(tmp_path / "ball", layout)
    path = next(root.glob("calibration*.json"))
    content = json.loads(path.read_text())
    content["cam1"]["distCoeff"] = [0.0] * 5
    path.write_text(json.dumps(content))
    open_capture(root)
    content["cam1"][field] = value
    path.write_text(json.dumps(content))
    with pytest.raises(BadData) as refusal:
        open_capture(root)
    assert message in refusal.value.what and "cam1" in refusal.value.where + refusal.value.what


def encode(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    "image",
    [
        MASK,
        MASK // 255,
        MASK.astype(np.uint16),
        MASK.astype(np.uint16) // 255,
        MASK.astype(np.uint16) * 257,
        np.dstack([MASK] * 3),
        np.dstack([np.zeros_like(MASK)] * 3 + [MASK]),
        np.dstack([RANDOM.integers(0, 255, (16, 24, 3), np.uint8), MASK]),
        np.dstack([MASK] * 3 + [np.full_like(MASK, 255)]),
        np.dstack([np.zeros((16, 24, 3), np.uint16), MASK.astype(np.uint16) * 257]),
    ],
)
def test_masks_are_read_in_every_form(image: np.ndarray, tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_mask(encode(tmp_path / "m.png", image)), MASK)


IDS = np.full((16, 24), 255, np.uint8)
IDS[2:8], IDS[8:14] = 3, 4


@pytest.mark.parametrize("image", [IDS, IDS.astype(np.uint16)])
def test_label_ids_are_their_values_in_8_and_16_bits(image: np.ndarray, tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_labels(encode(tmp_path / "l.png", image)), IDS)


@pytest.mark.parametrize("scale", [256, 257, 100])
def test_16_bit_label_images_that_are_scaled_are_refused(scale: int, tmp_path: Path) -> None:
    with pytest.raises(BadData, match="mean nothing"):
        read_labels(encode(tmp_path / "l.png", IDS.astype(np.uint16) * scale))


def test_label_images_of_few_bits_or_as_jpeg_are_refused(tmp_path: Path) -> None:
    binary = encode(tmp_path / "l.png", IDS)
    assert cv2.imwrite(str(binary), IDS // 255, [cv2.IMWRITE_PNG_BILEVEL, 1])
    with pytest.raises(BadData, match="1 bits a pixel"):
        read_labels(binary)
    encode(tmp_path / "l.jpg", IDS).rename(binary)
    with pytest.raises(BadData, match="not PNG"):
        read_labels(binary)


def exif(orientation: int, order: str) -> bytes:
    mark = b"II*\x00" if order == "<" else b"MM\x00*"
    return mark + struct.pack(order + "IHHHIHH", 8, 1, 0x0112, 3, 1, orientation, 0)


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_an_exif_orientation_other_than_upright_is_refused(
    kind: str, order: str, orientation: int, tmp_path: Path
) -> None:
    path = encode(tmp_path / f"a.{kind}", PICTURE)
    data, tag = path.read_bytes(), exif(orientation, order)
    if kind == "jpg":
        segment = b"Exif\x00\x00" + tag
        data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]
    else:
        chunk = b"eXIf" + tag
        data = (
            data[:33] + struct.pack(">I", len(tag)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
        )
    path.write_bytes(data)
    if orientation == 1:
        assert read_image(path).shape == PICTURE.shape
        return
    with pytest.raises(BadData, match=f"EXIF orientation {orientation}"):
        read_image(path)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.9])
@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_that_was_cut_and_ended_is_damaged(share: float, progressive: int, tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    noise = RANDOM.integers(0, 255, (256, 320, 3), np.uint8)
    assert cv2.imwrite(str(path), noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    assert read_image(path).shape == noise.shape
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))] + b"\xff\xd9")
    if progressive:
        try:
            read_image(path)
        except BadData as refusal:
            assert "damaged" in refusal.what
        return
    with pytest.raises(BadData, match="damaged"):
        read_image(path)


def test_endings_in_capitals_are_read(good: Path, tmp_path: Path) -> None:
    root = scene.copy(good, tmp_path / "ball")
    for path in [*root.glob("takes/*/rgb/cam1/*"), *root.glob("takes/*/masks/cam2/*")]:
        path.rename(path.with_suffix(path.suffix.upper()))
    assert open_capture(root).takes[0].frames == open_capture(good).takes[0].frames


def test_pipes_among_the_images_are_refused(good: Path, tmp_path: Path) -> None:
    import os

    root = scene.copy(good, tmp_path / "ball")
    for group in ("rgb", "masks"):
        path = next(root.glob(f"takes/walk/{group}/cam0/*1.png"))
        path.unlink()
        os.mkfifo(path)
    take = open_capture(root).takes[0]
    for read in (take.image, take.mask):
        with pytest.raises(GwError, match="pipe"):
            read("cam0", 1)


@pytest.mark.parametrize("sampling", [0x411111, 0x221111, 0x111111])
def test_a_progressive_jpeg_cut_between_its_scans_is_damaged(sampling: int, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (40, 56, 3)).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    data = cv2.imencode(".jpg", cv2.GaussianBlur(noise, (0, 0), 2), options)[1].tobytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    assert read_image(path).shape == (40, 56, 3)
    scans = [place for place in range(len(data)) if data[place : place + 2] == b"\xff\xda"]
    assert len(scans) > 5
    for place in scans[1:]:
        path.write_bytes(data[:place] + b"\xff\xd9")
        with pytest.raises(BadData, match="image is damaged"):
            read_image(path)


@pytest.mark.parametrize(
    "text",
    [
        "rgb/cam0/000001.png\n",
        "\ufeffrgb/cam0/000001.png\r\n",
        "rgb\\cam0\\000001.png",
        "# not used\n\nmasks/cam0/000001.png\n",
    ],
)
def test_lists_of_missing_images_are_honoured(text: str, good: Path, tmp_path: Path) -> None:
    root = scene.copy(good, tmp_path / "ball")
    (root / "takes/walk/missing_img_files.txt").write_bytes(text.encode())
    take = open_capture(root).takes[0]
    assert not take.has_image("cam0", 1) and take.has_image("cam1", 1)
    assert not any("match no image" in note for note in take.notes)


def test_entries_that_match_nothing_are_said(good: Path, tmp_path: Path) -> None:
    root = scene.copy(good, tmp_path / "ball")
    text = "cam0/000001.png\nrgb/cam0/000001.jpg\nrgb/cam0/000002.png\n"
    (root / "takes/walk/missing_img_files.txt").write_text(text)
    notes = open_capture(root).notes
    assert any("2 of 3 entries of missing_img_files.txt match no image" in note for note in notes)

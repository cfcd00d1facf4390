"""Captures with bytes changed, cut, doubled or left out: they open, or an error with a cure says why not."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.shared.capture import open_capture
from stages.shared.capture.images import read_image
from stages.shared.errors import BadData, GwError
from tests.shared.capture import scene

MUTANTS = 120


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scene.write_native(tmp_path_factory.mktemp("good") / "ball", frames=2)


def mutate(data: bytes, random: np.random.Generator) -> bytes:
    """A file with bytes changed, cut, doubled or left out."""
    changed = bytearray(data)
    for _ in range(random.integers(1, 6)):
        place = int(random.integers(len(changed)))
        match random.integers(5):
            case 0:
                changed[place] = random.integers(256)
            case 1:
                changed[place] ^= 1 << random.integers(8)
            case 2:
                del changed[place : place + int(random.integers(1, 20))]
            case 3:
                changed[place:place] = changed[place // 2 : place // 2 + int(random.integers(1, 20))]
            case _:
                changed = changed[: max(place, 1)]
        if not changed:
            changed = bytearray(b"\0")
    return bytes(changed)


@pytest.mark.parametrize(
    "name",
    [
        "cameras.json",
        "capture.json",
        "takes/walk/smpl_params.npz",
        "takes/walk/rgb/cam1/000000.png",
        "takes/walk/masks/cam1/000000.png",
        "takes/walk/labels/cam1/000000.png",
    ],
)
def test_mutated_files_give_a_capture_or_an_error(good: Path, tmp_path: Path, name: str) -> None:
    """Any other exception fails the test. PNG pieces carry checksums, so no changed picture may pass."""
    root = scene.copy(good, tmp_path / "ball")
    data = (root / name).read_bytes()
    random = np.random.default_rng(zlib.crc32(name.encode()))
    refused = 0
    for _ in range(MUTANTS):
        mutant = mutate(data, random)
        (root / name).write_bytes(mutant)
        try:
            capture = open_capture(root)
            for take in capture.takes:
                if (take.cameras.keys() >= {"cam1"}) and take.has_image("cam1", 0):
                    take.image("cam1", 0), take.labels("cam1", 0), take.subject_box("cam1", 0)
        except GwError:
            refused += 1
    assert refused > MUTANTS // 4


@pytest.mark.parametrize("layout", ["actorshq", "thuman4", "avatarrex"])
def test_mutated_calibrations(tmp_path: Path, layout: str) -> None:
    if layout == "actorshq":
        root, name = scene.write_actorshq(tmp_path / "x", frames=1), "Sequence1/1x/calibration.csv"
    else:
        root = scene.write_animatable(tmp_path / "x", layout, frames=1)
        name = "calibration.json" if layout == "thuman4" else "calibration_full.json"
    data = (root / name).read_bytes()
    random = np.random.default_rng(3)
    refused = 0
    for _ in range(MUTANTS):
        (root / name).write_bytes(mutate(data, random))
        try:
            open_capture(root)
        except GwError:
            refused += 1
    assert refused > MUTANTS // 4


def test_mutated_photographs(tmp_path: Path) -> None:
    """JPEG has no checksums: a changed byte may give another picture, but never another exception."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8), (9, 9), 3)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    random = np.random.default_rng(1)
    path = tmp_path / "p.jpg"
    refused = 0
    for _ in range(3 * MUTANTS):
        path.write_bytes(mutate(data, random))
        try:
            image = read_image(path)
        except BadData:
            refused += 1
            continue
        assert image.dtype == np.uint8 and image.ndim == 3
    assert refused > MUTANTS // 4

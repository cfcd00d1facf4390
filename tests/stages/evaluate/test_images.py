"""Any two folders of pictures can be scored, with masks or without."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage.metrics import structural_similarity
from typer.testing import CliRunner

from gw_cli.app import app
from stages.evaluate import stage
from stages.evaluate.config import EvaluateConfig, EvaluateInputs
from stages.shared.errors import BadData, MissingInput
from stages.shared.metrics.scores import NAMES

SHIFT, SIZE = 10, 40


def _write(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Pictures that differ from the truth by SHIFT inside a square, wildly outside; masks of the square."""
    random = np.random.default_rng(0)
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[10:30, 8:28] = 255
    for name in ("a/000", "a/001", "b"):
        truth = random.integers(50, 200, (SIZE, SIZE, 3)).astype(np.uint8)
        picture = np.where(mask[..., None] > 0, truth + np.uint8(SHIFT), np.uint8(0))
        _write(tmp_path / f"truth/{name}.png", truth)
        _write(tmp_path / f"pictures/{name}.png", picture)
        _write(tmp_path / f"masks/{name}.png", mask)
    _write(tmp_path / "pictures/extra.png", picture)
    return tmp_path / "pictures", tmp_path / "truth", tmp_path / "masks"


def test_with_masks_only_the_foreground_counts(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    pictures, truth, masks = folders
    result = stage.run(
        EvaluateInputs(images=pictures, truth=truth, masks=masks),
        tmp_path / "out",
        EvaluateConfig(pictures=1),
    )
    scores = result.summary["images"]
    assert scores["views"] == 3 and result.summary["unmatched"] == 1
    assert scores["psnr_foreground"] == pytest.approx(20 * math.log10(255 / SHIFT), abs=1e-6)
    share = 400 / SIZE**2  # white outside the mask in both: the paper's way
    assert scores["psnr"] == pytest.approx(20 * math.log10(255 / SHIFT) - 10 * math.log10(share), abs=1e-6)
    assert scores["lpips"] is None and scores["miou"] is None and 0 < scores["flip"] < 0.5
    rows = json.loads((tmp_path / "out/views.json").read_text())["images"]
    assert [row["camera"] for row in rows] == ["a/000", "a/001", "b"]
    assert (tmp_path / "out/images_0.png").is_file()


def test_alpha_of_the_truth_is_a_mask(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    pictures, truth, masks = folders
    for name in ("a/000", "a/001", "b"):
        color = cv2.imread(str(truth / f"{name}.png"))
        _write(truth / f"{name}.png", np.dstack([color, cv2.imread(str(masks / f"{name}.png"), 0)]))
    scores = stage.run(
        EvaluateInputs(images=pictures, truth=truth), tmp_path / "out", EvaluateConfig(pictures=0)
    ).summary["images"]
    assert scores["psnr_foreground"] == pytest.approx(20 * math.log10(255 / SHIFT), abs=1e-6)


def test_without_a_mask_nothing_is_foreground(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    pictures, truth, _ = folders
    scores = stage.run(
        EvaluateInputs(images=pictures, truth=truth), tmp_path / "out", EvaluateConfig(pictures=0)
    ).summary["images"]
    assert set(scores) == {"views", *NAMES}
    assert scores["psnr_foreground"] is scores["ssim_foreground"] is scores["iou"] is None
    found = []
    for name in ("a/000", "a/001", "b"):
        one, other = (cv2.imread(str(folder / f"{name}.png")) for folder in (pictures, truth))
        found.append(structural_similarity(one, other, win_size=11, channel_axis=2, data_range=255))
    assert scores["ssim"] == pytest.approx(np.mean(found), abs=1e-5)


def test_what_cannot_be_paired_is_refused(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    pictures, truth, masks = folders
    (masks / "b.png").unlink()
    with pytest.raises(MissingInput, match="mask for b"):
        stage.run(EvaluateInputs(images=pictures, truth=truth, masks=masks), tmp_path / "out")
    _write(truth / "b.png", np.zeros((SIZE, SIZE + 1, 3), np.uint8))
    with pytest.raises(BadData, match="40 x 40 pixels, the truth 41 x 40"):
        stage.run(EvaluateInputs(images=pictures, truth=truth), tmp_path / "out")
    with pytest.raises(MissingInput, match="same name"):
        stage.run(EvaluateInputs(images=pictures / "a", truth=truth), tmp_path / "out")
    with pytest.raises(MissingInput, match="no such folder"):
        stage.run(EvaluateInputs(images=pictures, truth=tmp_path / "none"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_command(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    pictures, truth, masks = (str(path) for path in folders)
    words = ["evaluate", "--images", pictures, "--truth", truth, "--masks", masks, "--json"]
    assert CliRunner().invoke(app, [*words, "--dry-run"]).exit_code == 0
    done = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["result"]["images"]["views"] == 3

"""What the parts of try-on are worth, on tubes whose truth is their own render."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stages.shared.errors import UsageProblem
from stages.shared.metrics.scores import ViewPair
from tests.benchmarks.tryon import stage
from tests.benchmarks.tryon.__main__ import app
from tests.benchmarks.tryon.config import BenchTryonConfig
from tests.benchmarks.tryon.scores import tryon_scores


def test_scores_of_the_region_and_of_skin_that_shows() -> None:
    truth, labels = np.full((40, 40, 3), 100, np.uint8), np.full((40, 40), 255, np.uint8)
    labels[5:35, 5:35], labels[10:30, 10:30] = 0, 4
    mask = np.where(labels < 255, np.uint8(255), np.uint8(0))
    shown = labels.copy()
    shown[10:15, 10:30] = 0  # a quarter of the garment shows skin
    scores = tryon_scores(ViewPair(truth, mask / np.float32(255), truth, mask, shown, labels), 4)
    assert scores["region_iou"] == 0.75 and scores["skin_through"] == 250 and scores["iou"] == 1
    same = tryon_scores(ViewPair(truth, mask / np.float32(255), truth, mask, labels, labels), 4)
    assert same["region_iou"] == 1 and same["region_ssim"] == 1 and same["skin_through"] == 0
    assert scores["region_ssim"] is not None and scores["region_ssim"] < 0.9
    assert (
        tryon_scores(ViewPair(truth, mask / np.float32(255), truth, mask, labels, labels), 5)["region_iou"]
        is None
    )


def test_every_variant_against_the_truth(dressed_subject: Path, wardrobe: Path, tmp_path: Path) -> None:
    bundles = [wardrobe / f"{name}.gwg" for name in ("body", "lower", "upper")]
    config = BenchTryonConfig(("none", "penetration", "all"), frame_step=3, pictures=1)
    truth = dressed_subject.parent / "capture"
    out = tmp_path / "bench"
    summary = stage.run(bundles, wardrobe / "motion.npz", truth, out, config).summary
    assert summary["region"] == "lower" and summary["views"] == 2 * 3
    for scores in summary["variants"].values():
        assert scores["region_iou"] > 0.95 and scores["psnr_foreground"] > 30
    assert set(summary["helps"]) == {"penetration"}
    assert json.loads((out / "bench_tryon.json").read_text())["variants"] == summary["variants"]
    assert len((out / "table.md").read_text().splitlines()) == 2 + 3
    assert (out / "compare_0.png").is_file()
    with pytest.raises(UsageProblem, match="no variant"):
        stage.run(bundles, wardrobe / "motion.npz", truth, out, BenchTryonConfig(("magic",)))


def test_command_wants_something_to_compare_with(wardrobe: Path, tmp_path: Path) -> None:
    assert CliRunner().invoke(app, [str(wardrobe / "body.gwg")]).exit_code == 2
    assert CliRunner().invoke(app, [str(tmp_path)]).exit_code == 66

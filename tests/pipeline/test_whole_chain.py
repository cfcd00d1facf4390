"""The commands a newcomer types, one after the other, on a tiny synthetic subject."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.pipeline.chain import ORDER, TINY, gw

pytestmark = pytest.mark.timeout(900)  # the first of these makes the chain


def _states(folder: Path, subject: str = "subject") -> dict[str, tuple[str, str]]:
    result = gw("status", subject, folder=folder)
    return {row["stage"]: (row["state"], " ".join(row["reasons"])) for row in result["stages"]}


def test_everything_is_up_to_date_and_verified(made: Path) -> None:
    assert {stage: state for stage, (state, _) in _states(made).items()} == dict.fromkeys(ORDER, "up to date")
    assert gw("verify", "subject", folder=made)["damaged"] == []


def test_a_second_run_makes_nothing_new(made: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (made / "subject").glob("*/*/manifest.json")}
    gw("train", "subject", *TINY, folder=made)
    after = {path: path.stat().st_mtime_ns for path in (made / "subject").glob("*/*/manifest.json")}
    assert before == after and len(before) == len(ORDER)


@pytest.mark.parametrize(
    ("pictures", "number", "stale"),
    [
        ("labels/cam01", 0, {"segment-layers", "bake-maps", "train"}),
        ("rgb/cam02", 1, {"train"}),
    ],
)
def test_a_changed_input_makes_what_follows_stale_and_says_why(
    made: Path, tmp_path: Path, pictures: str, number: int, stale: set[str]
) -> None:
    shutil.copytree(made, tmp_path / "copy", dirs_exist_ok=True)
    take = tmp_path / "copy" / "people" / "subject_1" / "takes" / "train"
    path = sorted((take / pictures).iterdir())[number]
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    picture[0, 0] = 255 if picture[0, 0].max() == 0 else 0
    cv2.imwrite(str(path), picture)
    states = _states(tmp_path / "copy")
    assert {stage for stage, (state, _) in states.items() if state == "stale"} == stale
    first = min(stale, key=ORDER.index)
    assert path.name in states[first][1]


def test_the_trained_subject_is_scored_and_its_skirt_is_worn(made: Path) -> None:
    scores = gw("evaluate", "subject", *TINY, "-o", "scores", folder=made)
    for split in ("novel_pose", "novel_view"):
        for method in ("trained", "baseline"):
            assert np.isfinite(scores[split][method]["psnr_foreground"])
            assert 0 < scores[split][method]["iou"] <= 1
    for layer in ("body", "lower"):
        gw("export-garment", "subject", "--layer", layer, "-o", f"{layer}.gwg", folder=made)
    bundles = ("body.gwg", "lower.gwg")
    gw("tryon", *bundles, "--poses", "people/motions/held_out.npz", *TINY, "-o", "worn", folder=made)
    result = json.loads((made / "worn" / "result.json").read_text())
    assert list((made / "worn").glob("*.mp4")) or list((made / "worn").glob("*.webm"))
    assert len(list((made / "worn").rglob("*.png"))) >= len(result["frames"])

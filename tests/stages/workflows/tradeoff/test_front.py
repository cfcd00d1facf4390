"""The front, the choice of a point, the picture and the file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.shared.errors import BadData, MissingInput
from stages.workflows.tradeoff.config import BenchTradeoffConfig
from stages.workflows.tradeoff.figure import markdown, tradeoff_page, tradeoff_picture
from stages.workflows.tradeoff.front import OperatingPoint, fast_enough, given_up, good_enough, on_front
from stages.workflows.tradeoff.stage import RESULT_NAME, read_points, write_results

POSE = {"psnr_foreground": 13.0, "ssim_foreground": 0.7, "miou": 0.8, "sharpness": 0.5}


def _point(name: str, rate: float, psnr: float, ssim: float) -> OperatingPoint:
    return OperatingPoint(name, 6.5, name[:1], 1000, psnr, ssim, 0.9, 0.5, POSE, rate, 5.0, 10**6, 10**8)


SLOW, FAST, FASTEST = (
    _point("a slow", 2, 17.0, 0.84),
    _point("b fast", 30, 16.9, 0.83),
    _point("c", 90, 15.0, 0.80),
)
WORSE = _point("d worse", 20, 16.0, 0.82)
SHARP = _point("e", 10, 16.5, 0.85)
ALL = (FAST, SLOW, WORSE, FASTEST, SHARP)


def test_front_holds_what_nothing_beats_in_everything() -> None:
    assert on_front(ALL) == [SLOW, SHARP, FAST, FASTEST]
    assert on_front([FAST, replace(FAST, name="same")]) == [FAST, replace(FAST, name="same")]


def test_choosing_by_rate_and_by_quality() -> None:
    assert fast_enough(ALL, 25) is FAST and fast_enough(ALL, 1) is SLOW and fast_enough(ALL, 31) is FASTEST
    with pytest.raises(MissingInput, match=r"c, reached 90\.0"):
        fast_enough(ALL, 100)
    assert good_enough(ALL, 0.0) is SLOW and good_enough(ALL, 0.3) is FAST and good_enough(ALL, 9) is FASTEST
    assert "0.10 dB" in given_up(ALL, FAST) and "best" in given_up(ALL, SLOW)


def test_picture_page_and_table_show_every_point() -> None:
    front = on_front(ALL)
    picture = tradeoff_picture(ALL, front)
    assert picture.dtype == np.uint8 and picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 10
    moved = tradeoff_picture([*ALL[:-1], replace(SHARP, psnr_foreground=15.5)], front)
    assert not np.array_equal(picture, moved)
    page, table = tradeoff_page(ALL, front, "<Trade>"), markdown(ALL, front)
    for point in ALL:
        assert point.name in page and f"| {point.name} |" in table
    assert "&lt;Trade&gt;" in page and "http" not in page and "data:image/png;base64," in page
    assert "| d worse |  |" in table and "| b fast | yes |" in table


def test_file_is_read_back(tmp_path: Path) -> None:
    write_results(tmp_path, "subject", ALL, BenchTradeoffConfig())
    assert read_points(tmp_path) == list(ALL)
    stored = json.loads((tmp_path / RESULT_NAME).read_bytes())
    assert [point["on_front"] for point in stored["points"]] == [True, True, False, True, True]


@pytest.mark.parametrize("text", ["{}", "[]", "nonsense", '{"points": []}', '{"points": [{"name": "x"}]}'])
def test_a_broken_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / RESULT_NAME).write_text(text)
    with pytest.raises(BadData):
        read_points(tmp_path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="gw bench tradeoff"):
        read_points(tmp_path)

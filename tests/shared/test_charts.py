"""Charts: lines rise where values rise, wide ranges are logarithmic, and matplotlib is an extra."""

from __future__ import annotations

import numpy as np
import pytest

from stages.shared import charts
from stages.shared.charts import Curve, Panel, check_charts, draw_charts
from stages.shared.errors import MissingInput

FIRST, SECOND = (31, 119, 180), (255, 127, 14)  # matplotlib's first two colours


def places(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """(C, 2) column and middle row of a colour in the panel, for every column that has it."""
    close = (np.abs(picture.astype(int) - color) < 25).all(axis=2)[:560]
    return np.array([(x, np.flatnonzero(close[:, x]).mean()) for x in np.flatnonzero(close.any(axis=0))])


def test_lines_rise_where_values_rise() -> None:
    curves = [Curve("up", [(1, 10), (10, 20)]), Curve("down", [(1, 20), (10, 10)])]
    picture = draw_charts([[Panel("title", "minutes", curves)]])
    up, down = places(picture, FIRST), places(picture, SECOND)
    assert up[0, 1] > up[-1, 1] + 150 and down[0, 1] < down[-1, 1] - 150
    assert abs(up[0, 0] - down[0, 0]) < 12
    two = [[Panel("title", "minutes", curves), Panel("empty", "minutes", [Curve("up", [])])]]
    assert draw_charts(two).shape[1] == 1800 and picture.dtype == np.uint8


def test_wide_ranges_are_logarithmic() -> None:
    """On a logarithmic axis the curve y = log x is a straight line."""

    def bend(minutes: list[float]) -> float:
        line = places(draw_charts([[Panel("", "", [Curve("a", [(m, np.log2(m)) for m in minutes])])]]), FIRST)
        straight = np.polyval(np.polyfit(*line.T, 1), line[:, 0])
        return float(np.abs(line[:, 1] - straight).max())

    assert bend([1.0, 2, 4, 8, 16, 64]) < 15 and bend([1.0, 2, 4, 8]) > 25


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "find_spec", lambda name: None)
    with pytest.raises(MissingInput, match="gaussian-wardrobe\\[charts\\]"):
        check_charts()

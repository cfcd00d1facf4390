"""Line charts as a picture, drawn with OpenCV: panels in a grid, one colour per name, a legend."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
COLORS = ((27, 108, 168), (200, 85, 61), (58, 125, 68), (142, 94, 162), (184, 134, 11), (85, 85, 85))
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 520, 340, 62, 14, 34, 46
_LEGEND = 26  # px per line
_FINE = 2  # drawn so many times larger, then made smaller
_INK, _LINE = (40, 40, 40), (225, 225, 225)


@dataclass(frozen=True)
class Curve:
    """A line: its name and its (x, y) points."""

    name: str
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One chart; curves of the same name have the same colour in all panels."""

    title: str
    x_name: str
    curves: list[Curve]


def figure(rows: list[list[Panel]]) -> Picture:
    """All panels, and below them the legend: (H, W, 3) u8."""
    names = list(dict.fromkeys(curve.name for row in rows for panel in row for curve in panel.curves))
    colors = {name: COLORS[index % len(COLORS)] for index, name in enumerate(names)}
    grid = np.vstack([np.hstack([_panel(panel, colors) for panel in row]) for row in rows])
    legend = np.full((_FINE * (_LEGEND * len(names) + 8), grid.shape[1], 3), 255, np.uint8)
    for index, name in enumerate(names):
        y = _LEGEND * index + 16
        _stroke(legend, (_LEFT, y), (_LEFT + 30, y), colors[name], 2)
        _text(legend, name, (_LEFT + 40, y + 5))
    whole = np.vstack([grid, legend])
    size = (whole.shape[1] // _FINE, whole.shape[0] // _FINE)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers from at most `low` to at least `high`."""
    span = max(high - low, 1e-9 * max(abs(low), abs(high), 1.0))
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * index for index in range(first, max(last, first + 1) + 1)]


def _panel(panel: Panel, colors: dict[str, tuple[int, int, int]]) -> Picture:
    canvas = np.full((_FINE * _HEIGHT, _FINE * _WIDTH, 3), 255, np.uint8)
    points = [point for curve in panel.curves for point in curve.points]
    _text(canvas, panel.title, (_LEFT, 20))
    if not points:
        _text(canvas, "nothing measured yet", (_LEFT + 20, _HEIGHT // 2))
        return canvas
    across = ticks(0.0, max(x for x, _ in points))
    up = ticks(min(y for _, y in points), max(y for _, y in points))

    def place(x: float, y: float) -> tuple[float, float]:
        right = (x - across[0]) / (across[-1] - across[0])
        height = (y - up[0]) / (up[-1] - up[0])
        return (
            _LEFT + right * (_WIDTH - _LEFT - _RIGHT),
            _HEIGHT - _BOTTOM - height * (_HEIGHT - _TOP - _BOTTOM),
        )

    for value in up:
        x, y = place(across[0], value)
        _stroke(canvas, (x, y), (_WIDTH - _RIGHT, y), _LINE, 1)
        _text(canvas, f"{value:.4g}", (6, y + 4))
    for value in across:
        x, y = place(value, up[0])
        _stroke(canvas, (x, y), (x, _TOP), _LINE, 1)
        _text(canvas, f"{value:.4g}", (x - 8, y + 16))
    _text(canvas, panel.x_name, (_WIDTH // 2 - 50, _HEIGHT - 10))
    for curve in panel.curves:
        spots = [place(x, y) for x, y in sorted(curve.points)]
        for one, other in pairwise(spots):
            _stroke(canvas, one, other, colors[curve.name], 2)
        for x, y in spots:
            middle = round(_FINE * x), round(_FINE * y)
            cv2.circle(canvas, middle, 3 * _FINE, colors[curve.name], -1, cv2.LINE_AA)
    return canvas


def _stroke(
    canvas: Picture,
    start: tuple[float, float],
    end: tuple[float, float],
    color: tuple[int, int, int],
    width: int,
) -> None:
    corners = [(round(_FINE * x), round(_FINE * y)) for x, y in (start, end)]
    cv2.line(canvas, corners[0], corners[1], color, width * _FINE, cv2.LINE_AA)


def _text(canvas: Picture, text: str, place: tuple[float, float]) -> None:
    corner = round(_FINE * place[0]), round(_FINE * place[1])
    cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.42 * _FINE, _INK, _FINE // 2, cv2.LINE_AA)

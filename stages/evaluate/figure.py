"""Line charts as a picture, drawn with OpenCV: panels in a grid, one colour and mark per name, a legend.

Two panels are 1800 px wide, so the text stays readable on a page that shows them at 900 px.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Color = tuple[int, int, int]
COLORS: tuple[Color, ...] = (
    (27, 108, 168), (200, 85, 61), (58, 125, 68), (142, 94, 162), (184, 134, 11), (85, 85, 85),
    (0, 150, 160), (190, 60, 120),
)  # fmt: skip
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 900, 560, 122, 34, 62, 96
_LEGEND_ROW, _LEGEND_COLUMNS = 46, 2
_LETTERS, _TITLE = 0.85, 0.92  # scales of OpenCV's letters
_INK, _LINE = (40, 40, 40), (222, 222, 222)
_DECADES = 12.0  # times the first minute: from there on minutes are drawn by their logarithm


@dataclass(frozen=True)
class Curve:
    """A line: its name and its (x, y) points."""

    name: str
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One chart; curves of the same name have the same colour and mark in all panels."""

    title: str
    x_name: str
    curves: list[Curve]


@dataclass(frozen=True)
class _Axis:
    """Values at which there are lines, and the share 0..1 of the way from the first to the last of them."""

    marks: list[float]
    share: Callable[[float], float]


def figure(rows: list[list[Panel]]) -> Picture:
    """All panels, and below them the legend: (H, W, 3) u8."""
    names = list(dict.fromkeys(curve.name for row in rows for panel in row for curve in panel.curves))
    styles = {name: index for index, name in enumerate(names)}
    grid = np.vstack([np.hstack([_panel(panel, styles) for panel in row]) for row in rows])
    columns = min(_LEGEND_COLUMNS, max(1, grid.shape[1] // _WIDTH))
    legend = np.full((_LEGEND_ROW * math.ceil(len(names) / columns) + 20, grid.shape[1], 3), 255, np.uint8)
    for name, style in styles.items():
        row, column = divmod(style, columns)
        x, y = column * _WIDTH + _LEFT, _LEGEND_ROW * row + 24
        _stroke(legend, (x, y), (x + 70, y), _color(style), 4)
        _mark(legend, (x + 35, y), style)
        _text(legend, name, (x + 90, y + 9))
    return np.vstack([grid, legend])


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers from at most `low` to at least `high`."""
    span = max(high - low, 1e-9 * max(abs(low), abs(high), 1.0))
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * index for index in range(first, max(last, first + 1) + 1)]


def growing_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5, 10, 20, … from at most `low` > 0 to at least `high`."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    known = [factor * 10.0**power for power in range(first, last + 1) for factor in (1, 2, 5)]
    start = max(index for index, value in enumerate(known) if value <= low * (1 + 1e-9))
    end = min(index for index, value in enumerate(known) if value >= high * (1 - 1e-9))
    return known[start : max(end, start + 1) + 1]


def _across(values: list[float]) -> _Axis:
    """Minutes: evenly from 0, or by their logarithm where they span much."""
    low, high = min(values), max(values)
    if low > 0 and high > _DECADES * low:
        marks = growing_ticks(low, high)
        start, span = math.log(marks[0]), math.log(marks[-1] / marks[0])
        return _Axis(marks, lambda value: (math.log(value) - start) / span)
    return _even(ticks(0.0, high))


def _even(marks: list[float]) -> _Axis:
    return _Axis(marks, lambda value: (value - marks[0]) / (marks[-1] - marks[0]))


def _panel(panel: Panel, styles: dict[str, int]) -> Picture:
    canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    points = [point for curve in panel.curves for point in curve.points]
    _text(canvas, panel.title, (_LEFT, 38), _TITLE)
    if not points:
        _text(canvas, "nothing measured yet", (_LEFT + 20, _HEIGHT // 2))
        return canvas
    across = _across([x for x, _ in points])
    up = _even(ticks(min(y for _, y in points), max(y for _, y in points)))

    def place(x: float, y: float) -> tuple[float, float]:
        right = _LEFT + across.share(x) * (_WIDTH - _LEFT - _RIGHT)
        return right, _HEIGHT - _BOTTOM - up.share(y) * (_HEIGHT - _TOP - _BOTTOM)

    places = max(0, -math.floor(math.log10(up.marks[1] - up.marks[0]) + 1e-9))
    for value in up.marks:
        x, y = place(across.marks[0], value)
        _stroke(canvas, (x, y), (_WIDTH - _RIGHT, y), _LINE, 2)
        _text(canvas, f"{value:.{places}f}", (x - 14, y + 10), anchor=1.0)
    for value in across.marks:
        x, y = place(value, up.marks[0])
        _stroke(canvas, (x, y), (x, _TOP), _LINE, 2)
        _text(canvas, f"{value:.4g}", (x, y + 36), anchor=0.5)
    _text(canvas, panel.x_name, (_LEFT + (_WIDTH - _LEFT - _RIGHT) / 2, _HEIGHT - 16), anchor=0.5)
    for curve in panel.curves:
        style = styles[curve.name]
        spots = [place(x, y) for x, y in sorted(curve.points)]
        for one, other in pairwise(spots):
            _stroke(canvas, one, other, _color(style), 4)
        for spot in spots:
            _mark(canvas, spot, style)
    return canvas


def _color(style: int) -> Color:
    return COLORS[style % len(COLORS)]


def _mark(canvas: Picture, place: tuple[float, float], style: int) -> None:
    """A disc, a square, a triangle or a diamond; where colours come again, hollow ones."""
    x, y = place
    fill = _color(style) if style < len(COLORS) else (255, 255, 255)
    corners = {0: 24, 1: 4, 2: 3, 3: 4}[style % 4]
    turn = {0: 0.0, 1: math.pi / 4, 2: -math.pi / 2, 3: 0.0}[style % 4]
    size = 8 if corners > 4 else 10
    angles = turn + 2 * math.pi * np.arange(corners) / corners
    outline = np.rint(np.stack([x + size * np.cos(angles), y + size * np.sin(angles)], axis=1)).astype(
        np.int32
    )
    cv2.fillPoly(canvas, [outline], fill, cv2.LINE_AA)
    cv2.polylines(canvas, [outline], True, _color(style), 2, cv2.LINE_AA)


def _stroke(
    canvas: Picture, start: tuple[float, float], end: tuple[float, float], color: Color, width: int
) -> None:
    corners = [(round(x), round(y)) for x, y in (start, end)]
    cv2.line(canvas, corners[0], corners[1], color, width, cv2.LINE_AA)


def _text(
    canvas: Picture, text: str, place: tuple[float, float], scale: float = _LETTERS, anchor: float = 0.0
) -> None:
    """Letters whose left end (`anchor` 0), middle (0.5) or right end (1) is at `place`, above it."""
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
    corner = round(place[0] - anchor * width), round(place[1])
    cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 2, cv2.LINE_AA)

"""A log-log line chart as SVG, written without a plotting library."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.sax.saxutils import escape

_COLORS = ("#1b6ca8", "#c8553d", "#3a7d44", "#8e5ea2", "#b8860b", "#555555")
_WIDTH, _HEIGHT, _LEFT, _TOP, _RIGHT, _BOTTOM = 640, 400, 70, 40, 170, 50


@dataclass(frozen=True)
class Series:
    """A line: its name and its (x, y) points, all positive."""

    name: str
    points: list[tuple[float, float]]


def chart(title: str, x_name: str, y_name: str, series: list[Series]) -> str:
    """The SVG text. Both axes logarithmic: a slope of one is a cost that grows in proportion."""
    points = [point for line in series for point in line.points]
    if not points:
        return ""
    x_low, x_high = _decades([x for x, _ in points])
    y_low, y_high = _decades([y for _, y in points])
    inner_width, inner_height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        across = (math.log10(x) - x_low) / (x_high - x_low)
        up = (math.log10(y) - y_low) / (y_high - y_low)
        return _LEFT + across * inner_width, _TOP + (1 - up) * inner_height

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif" '
        f'font-size="12"><rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        f'<text x="{_LEFT}" y="22" font-size="15">{escape(title)}</text>',
        f'<text x="{_LEFT + inner_width / 2}" y="{_HEIGHT - 10}" text-anchor="middle">'
        f"{escape(x_name)}</text>",
        f'<text transform="translate(18 {_TOP + inner_height / 2}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_name)}</text>",
    ]
    for value in _ticks(x_low, x_high):
        x, _ = place(value, 10**y_low)
        parts.append(f'<path d="M{x:.1f} {_TOP}V{_TOP + inner_height}" stroke="#e5e5e5"/>')
        parts.append(
            f'<text x="{x:.1f}" y="{_TOP + inner_height + 16}" text-anchor="middle">{_label(value)}</text>'
        )
    for value in _ticks(y_low, y_high):
        _, y = place(10**x_low, value)
        parts.append(f'<path d="M{_LEFT} {y:.1f}h{inner_width}" stroke="#e5e5e5"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_label(value)}</text>')
    for index, line in enumerate(series):
        color = _COLORS[index % len(_COLORS)]
        placed = [place(*point) for point in sorted(line.points)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in placed)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in placed]
        y = _TOP + 14 + 18 * index
        parts.append(f'<text x="{_WIDTH - _RIGHT + 12}" y="{y}" fill="{color}">{escape(line.name)}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _decades(values: list[float]) -> tuple[float, float]:
    """Logarithms of the ends of an axis that holds the values, a little wider than they are."""
    low, high = math.log10(min(values)), math.log10(max(values))
    room = max(0.05 * (high - low), 0.1)
    return low - room, high + room


def _ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 of every decade, or the decades alone where that would be crowded."""
    steps = (1, 2, 5) if high - low < 3 else (1,)
    found = [step * 10.0**decade for decade in range(math.floor(low), math.ceil(high) + 1) for step in steps]
    return [value for value in found if low <= math.log10(value) <= high]


def _label(value: float) -> str:
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:g} {letter}"
    return f"{value:g}"

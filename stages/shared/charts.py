"""Charts by matplotlib (extra `charts`), as arrays of pixels: scores against minutes, and the trade-off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import MissingInput

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL = (4.5, 2.8)  # inches
_DPI = 200  # two panels are 1800 pixels wide, readable on a page that shows them at 900
_DECADES = 12.0  # times the first x value: from there on the x axis is logarithmic
_MARKS = "os^D"


@dataclass(frozen=True)
class Curve:
    """A line: its name and its (x, y) points."""

    name: str
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """One chart; curves of the same name have the same colour and mark in all panels.

    Attributes:
        joined: whether a line leads from point to point. front: (x, y) of a grey line behind the curves.
        labels: texts at points, {(x, y): text}. log_x: a logarithmic axis; None: where x spans much.
    """

    title: str
    x_name: str
    curves: list[Curve]
    joined: bool = True
    front: Sequence[tuple[float, float]] = ()
    labels: Mapping[tuple[float, float], str] = field(default_factory=dict)
    log_x: bool | None = None


def check_charts() -> None:
    """Raise MissingInput where matplotlib is not installed; called before a long run begins."""
    if find_spec("matplotlib") is None:
        raise MissingInput(
            "Charts need matplotlib, which is not installed.",
            "extra charts",
            "Install it: pip install 'gaussian-wardrobe[charts]'.",
        )


def draw_charts(rows: Sequence[Sequence[Panel]]) -> NDArray[np.uint8]:
    """All panels in a grid, and below them one legend: (H, W, 3) u8 sRGB. No display is needed."""
    check_charts()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(curve.name for row in rows for panel in row for curve in panel.curves))
    columns = max(map(len, rows))
    figure = Figure((_PANEL[0] * columns, _PANEL[1] * len(rows) + 0.25 * len(names)), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    lines: dict[str, Any] = {}
    for row, places in zip(rows, axes, strict=True):
        for panel, place in zip(row, places, strict=True):
            _draw(panel, place, names, lines)
    figure.legend([lines[name] for name in names if name in lines], [name for name in names if name in lines],
                  loc="outside lower center", ncols=min(2, columns), frameon=False)  # fmt: skip
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _draw(panel: Panel, axes: Axes, names: Sequence[str], lines: dict[str, Any]) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.set_xlabel(panel.x_name)
    axes.grid(color="0.87")
    axes.set_axisbelow(True)
    x_values = [x for curve in panel.curves for x, _ in curve.points]
    if not x_values:
        axes.text(0.5, 0.5, "nothing measured yet", ha="center", transform=axes.transAxes)
        return
    if panel.front:
        axes.plot(*zip(*panel.front, strict=True), color="0.73", linewidth=1)
    for curve in panel.curves:
        if curve.points:
            index = names.index(curve.name)
            lines[curve.name] = axes.plot(
                *zip(*sorted(curve.points), strict=True),
                color=f"C{index % 10}",
                marker=_MARKS[index % len(_MARKS)],
                linestyle="-" if panel.joined else "none",
                markerfacecolor=None if index < 10 else "white",
            )[0]
    spread = min(x_values) > 0 and max(x_values) > _DECADES * min(x_values)
    if spread if panel.log_x is None else panel.log_x:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
    else:
        axes.set_xlim(left=0)
    for place, text in panel.labels.items():
        axes.annotate(text, place, (5, -3), textcoords="offset points", fontsize=7)

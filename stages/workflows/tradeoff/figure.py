"""Charts of the trade-off (PSNR and SSIM against frames per second), their page, and the table."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.pictures import encode_png
from stages.workflows.tradeoff.front import OperatingPoint

_WIDTH, _HEIGHT, _MARGIN = 560, 400, 60
_COLORS = ((27, 108, 168), (200, 85, 61), (58, 125, 68), (142, 94, 162))
_AXES = (("psnr_foreground", "foreground PSNR, dB"), ("ssim_foreground", "foreground SSIM"))

Place = tuple[float, float]


def tradeoff_page(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint], title: str) -> str:
    """A page that needs no other file: the charts and the table."""
    picture = base64.b64encode(encode_png(tradeoff_picture(points, front))).decode()
    head = "<tr><th>" + "<th>".join(_ROW) + "</tr>"
    rows = "".join("<tr><td>" + "<td>".join(_cells(point, point in front)) + "</tr>" for point in points)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>' + html.escape(title) + "</title>"
        "<style>body{font:15px/1.5 sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem}"
        "img{max-width:100%}td,th{padding:.2rem .7rem;text-align:right}"
        "td:first-child,th:first-child{text-align:left}</style>"
        f"<h1>{html.escape(title)}</h1><img alt=charts src='data:image/png;base64,{picture}'>"
        f"<table>{head}{rows}</table></html>\n"
    )


_ROW = (
    "point", "on the front", "frames/s", "PSNR", "SSIM", "mIoU", "sharpness", "novel pose PSNR",
    "Gaussians", "training, min", "bundles, MB", "memory, MB",
)  # fmt: skip


def markdown(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint]) -> str:
    """The same table for a README."""
    lines = ["| " + " | ".join(_ROW) + " |", "|---|" + "---:|" * (len(_ROW) - 1)]
    return (
        "\n".join(lines + ["| " + " | ".join(_cells(point, point in front)) + " |" for point in points])
        + "\n"
    )


def _cells(point: OperatingPoint, best: bool) -> list[str]:
    return [
        html.escape(point.name), "yes" if best else "", f"{point.frames_per_second:.1f}",
        f"{point.psnr_foreground:.2f}", f"{point.ssim_foreground:.3f}", f"{point.miou:.3f}",
        f"{point.sharpness:.2f}", f"{point.novel_pose['psnr_foreground']:.2f}", f"{point.gaussians}",
        f"{point.training_minutes:.1f}", f"{point.bundle_bytes / 1e6:.1f}", f"{point.peak_bytes / 1e6:.0f}",
    ]  # fmt: skip


class _Scale:
    """Where a point lies: logarithmic to the right, linear upwards."""

    def __init__(self, points: Sequence[OperatingPoint], axis: str) -> None:
        self.axis = axis
        rates = [math.log10(point.frames_per_second) for point in points]
        values = [getattr(point, axis) for point in points]
        across, up = max(max(rates) - min(rates), 0.2), max(max(values) - min(values), 1e-3)
        self.left, self.right = min(rates) - 0.1 * across, max(rates) + 0.25 * across
        self.low, self.high = min(values) - 0.15 * up, max(values) + 0.15 * up

    def place(self, rate: float, value: float) -> Place:
        across = (math.log10(rate) - self.left) / (self.right - self.left)
        up = (value - self.low) / (self.high - self.low)
        return _MARGIN + across * (_WIDTH - 2 * _MARGIN), _HEIGHT - _MARGIN - up * (_HEIGHT - 2 * _MARGIN)

    def of(self, point: OperatingPoint) -> Place:
        return self.place(point.frames_per_second, getattr(point, self.axis))

    def rates(self) -> list[float]:
        """Round numbers on the lower axis."""
        steps = [s * 10.0**d for d in range(-2, 5) for s in (1, 2, 5)]
        return [rate for rate in steps if self.left <= math.log10(rate) <= self.right]

    def values(self) -> list[float]:
        """Five numbers on the left axis."""
        return [self.low + share * (self.high - self.low) for share in (0.05, 0.275, 0.5, 0.725, 0.95)]


def tradeoff_picture(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint]) -> NDArray[np.uint8]:
    """Both charts side by side, (H, W, 3) u8 sRGB."""
    return np.concatenate([_chart(points, front, axis, name) for axis, name in _AXES], axis=1)


def _chart(
    points: Sequence[OperatingPoint], front: Sequence[OperatingPoint], axis: str, name: str
) -> NDArray[np.uint8]:
    picture, scale = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8), _Scale(points, axis)
    bottom, grey, black = _HEIGHT - _MARGIN, (229, 229, 229), (40, 40, 40)
    for rate in scale.rates():
        x = round(scale.place(rate, scale.low)[0])
        cv2.line(picture, (x, _MARGIN), (x, bottom), grey, 1, cv2.LINE_AA)
        _write(picture, f"{rate:g}", (x - 8, bottom + 16), black)
    for value in scale.values():
        _write(picture, f"{value:.4g}", (8, round(scale.place(1.0, value)[1]) + 4), black)
    line = np.array([[round(place) for place in scale.of(point)] for point in front], np.int32)
    cv2.polylines(picture, [line], False, (187, 187, 187), 1, cv2.LINE_AA)
    for point in points:
        x, y = (round(place) for place in scale.of(point))
        cv2.circle(picture, (x, y), 5, _color(points, point), cv2.FILLED, cv2.LINE_AA)
        _write(picture, _label(point), (x + 8, y + 4), black)
    for row, decoder in enumerate(_decoders(points)):
        _write(picture, decoder, (_MARGIN + 4, bottom - 8 - 15 * row), _COLORS[row % len(_COLORS)])
    _write(picture, "frames per second", (_WIDTH // 2 - 50, _HEIGHT - 20), black)
    _write(picture, name, (_MARGIN, _MARGIN - 20), black, 0.5)
    return picture


def _write(
    picture: NDArray[np.uint8],
    text: str,
    place: tuple[int, int],
    color: tuple[int, int, int],
    size: float = 0.36,
) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)


def _color(points: Sequence[OperatingPoint], point: OperatingPoint) -> tuple[int, int, int]:
    """One colour per decoder."""
    return _COLORS[_decoders(points).index(point.decoder) % len(_COLORS)]


def _decoders(points: Sequence[OperatingPoint]) -> list[str]:
    """Their names, each once."""
    return sorted({point.decoder for point in points})


def _label(point: OperatingPoint) -> str:
    """Text next to a point: its pitch, and its preset where it has one. The colour tells the decoder."""
    return point.name.removesuffix("-" + point.decoder.replace(" ", "-")).replace("-", " ")

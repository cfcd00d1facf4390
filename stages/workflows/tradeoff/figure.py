"""Charts of the trade-off (PSNR and SSIM against frames per second), their page, and the table."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.pictures import encode_png
from stages.shared.charts import Curve, Panel, draw_charts
from stages.workflows.tradeoff.front import OperatingPoint

_AXES = (("psnr_foreground", "foreground PSNR, dB"), ("ssim_foreground", "foreground SSIM"))


def tradeoff_page(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint], title: str) -> str:
    """A self-contained page with the charts and the table."""
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
    """The table in Markdown."""
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


def tradeoff_picture(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint]) -> NDArray[np.uint8]:
    """Both charts next to each other, (H, W, 3) u8 sRGB: a colour per decoder, a line along the front."""
    return draw_charts([[_panel(points, front, axis, name) for axis, name in _AXES]])


def _panel(points: Sequence[OperatingPoint], front: Sequence[OperatingPoint], axis: str, name: str) -> Panel:
    places = {point.name: (point.frames_per_second, float(getattr(point, axis))) for point in points}
    decoders = sorted({point.decoder for point in points})
    return Panel(
        title=name,
        x_name="frames per second",
        curves=[
            Curve(decoder, [places[point.name] for point in points if point.decoder == decoder])
            for decoder in decoders
        ],
        joined=False,
        front=[places[point.name] for point in front],
        labels={places[point.name]: _label(point) for point in points},
        log_x=True,
    )


def _label(point: OperatingPoint) -> str:
    """Text next to a point: its pitch, and its preset where it has one. The colour shows the decoder."""
    return point.name.removesuffix("-" + point.decoder.replace(" ", "-")).replace("-", " ")

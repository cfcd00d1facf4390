"""What 16 bits cost: an outfit rendered with 32 bits everywhere, and with one kind of tensor rounded to 16.

Reads:
    bundles `.gwg` exported with `--precision float32`; a pose file.
Writes:
    one JSON file: per kind of tensor bytes before and after, PSNR (dB) against the full outfit over all
    pixels of all frames together, and the largest difference of a channel (of 255).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from gw_cli.console import Console
from gw_cli.options import Json
from stages.shared.artifacts.bundle import Bundle
from stages.shared.artifacts.bundle_precision import halved, may_be_half
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_whole
from stages.shared.body import Poses
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.metrics.picture import psnr
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.sources import read_bundles
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from tests.benchmarks.command import application

MARK = "gw-bench-precision"
Named = Sequence[tuple[str, Bundle]]


@dataclass(frozen=True)
class BenchPrecisionConfig:
    """What is rendered.

    Attributes:
        frames: rows of the motion, evenly spread. width, height: pixels.
    """

    frames: int = 6
    width: int = 360
    height: int = 480


@dataclass(frozen=True)
class BenchPrecisionResult:
    """The file, and what it says."""

    path: Path
    summary: dict[str, Any]


def run(
    bundles: Sequence[Path],
    poses_path: Path,
    output: Path,
    config: BenchPrecisionConfig = BenchPrecisionConfig(),
    report: Report = SILENT,
) -> BenchPrecisionResult:
    """Round each kind of tensor by itself, then all of them.

    Raises:
        UsageProblem: a bundle is already rounded.
    """
    named = read_bundles(bundles)
    for name, bundle in named:
        if any(array.dtype == np.float16 for array in bundle.arrays.values()):
            raise UsageProblem(
                "The bundle has 16 bits already.",
                name,
                "Export it with --precision float32.",
            )
    poses = load_poses(poses_path, outfit_of_bundles(named).body_model)
    rows = np.unique(np.linspace(0, len(poses) - 1, config.frames).round().astype(int)).tolist()
    report.step("rendering with 32 bits")
    truth = _pictures(named, poses, rows, config)
    kinds = sorted({_kind(name) for _, bundle in named for name in bundle.arrays if may_be_half(name)})
    found: dict[str, Any] = {}
    for kind in [*kinds, "all"]:
        report.step(f"rendering with 16 bits: {kind}")
        rounded = [(name, _rounded(bundle, kind)) for name, bundle in named]
        pictures = _pictures(rounded, poses, rows, config)
        difference = np.abs(pictures.astype(np.int16) - truth.astype(np.int16))
        score = psnr(pictures.reshape(-1, config.width, 3), truth.reshape(-1, config.width, 3))
        found[kind] = {
            "bytes_32": _bytes(named),
            "bytes_16": _bytes(rounded),
            "psnr": score if score is not None and np.isfinite(score) else None,
            "largest_difference": int(difference.max()),
        }
    summary = {"frames": len(rows), "kinds": found}
    content = {"format": MARK, "version": 1, "config": asdict(config), **summary}
    write_whole(output, readable_json(content))
    return BenchPrecisionResult(output, summary)


def _kind(name: str) -> str:
    """ "model", "swap" and "skin" as one, maps by their own names."""
    return name if name.startswith("maps/") else name.split("/")[0]


def _rounded(bundle: Bundle, kind: str) -> Bundle:
    """With 16 bits for one kind of tensor, or "all"."""
    half = halved(bundle.arrays)
    mixed = {name: half[name] if kind in ("all", _kind(name)) else a for name, a in bundle.arrays.items()}
    return replace(bundle, arrays=mixed)


def _pictures(named: Named, poses: Poses, rows: list[int], config: BenchPrecisionConfig) -> NDArray[np.uint8]:
    """(T, H, W, 3) u8 of the outfit, from the front, on white."""
    outfit = outfit_of_bundles(named)
    size = (config.width, config.height)
    cameras: list[Camera] = viewpoint_cameras("static", outfit.body_model, poses[rows], outfit.betas, size)
    shots = [
        render_image(outfit.composite(poses, row), camera).on((1.0, 1.0, 1.0))
        for row, camera in zip(rows, cameras, strict=True)
    ]
    return np.stack(shots)


def _bytes(named: Named) -> int:
    return sum(array.nbytes for _, bundle in named for array in bundle.arrays.values())


def precision(
    bundles: Annotated[
        list[Path],
        typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="Exported with --precision float32."),
    ],
    poses: Annotated[Path, typer.Option(help="The motion it is judged in.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="JSON file.")] = Path("precision.json"),
    frames: Annotated[int, typer.Option(min=1, help="How many frames of the motion.")] = 6,
    as_json: Json = False,
) -> None:
    """Measure what 16 bits cost in a bundle: for each kind of tensor bytes saved and dB lost."""

    console = Console(as_json)
    result = run(bundles, poses, output, BenchPrecisionConfig(frames=frames), console)
    console.result({"path": result.path, **result.summary})


app = application(precision)

if __name__ == "__main__":
    app()

"""What each part of try-on is worth: an outfit with and without swap, push-out and penetration pass, against
the truth.

Reads:
    bundles `.gwg`; a pose file; the truth: a native capture of the same body in the same garments and motion
    (images, masks, labels). Of a demo folder: wardrobe/*.gwg, synthetic/motions, synthetic/tryon_truth.
Writes, into the output folder:
    bench_tryon.json: {"region", "views", "variants": {name: {score: mean}}, "helps": {part: …}}; views.json:
    every view's scores; table.md: the means as a table; compare_<n>.png.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.bundle import Bundle
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.capture import Take, open_capture
from stages.shared.capture.camera import Camera
from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY_LABELS, GARMENT_LABELS
from stages.shared.metrics.scores import Scores, ViewPair
from stages.shared.outfit.layer import label_of
from stages.shared.outfit.outfit import outfit_of_bundles
from stages.shared.outfit.penetration import TRYON_MARGINS
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.sources import capture_take, read_bundles
from stages.shared.pictures.folder import check_output, output_folder
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.poses.read import load_poses
from stages.shared.render_sequence.sequence import capture_frames
from stages.shared.report import SILENT, Report
from tests.benchmarks.tryon.config import PARTS, VARIANTS, BenchTryonConfig
from tests.benchmarks.tryon.scores import NAMES, means, tryon_scores

MARK = "gw-bench-tryon"
RESULT_NAME = "bench_tryon.json"
_DEMO_OUTFIT = ("body_2", "shirt", "vest", "skirt")


@dataclass(frozen=True)
class BenchTryonResult:
    """The folder, and the means."""

    path: Path
    summary: dict[str, Any]


def demo_inputs(demo: Path) -> tuple[list[Path], Path, Path]:
    """Bundles, motion and truth in the folder of `gw demo`. Raises MissingInput where one is absent."""
    bundles = [demo / "wardrobe" / f"{name}.gwg" for name in _DEMO_OUTFIT]
    poses, truth = demo / "synthetic/motions/held_out.npz", demo / "synthetic/tryon_truth"
    for path in (*bundles, poses, truth):
        if not path.exists():
            raise MissingInput(
                "This is no finished demo.", str(path), f"Run gw demo -o {demo}, or name the bundles."
            )
    return bundles, poses, truth


def run(
    bundles: Sequence[Path],
    poses_path: Path,
    truth: Path,
    output: Path,
    config: BenchTryonConfig = BenchTryonConfig(),
    report: Report = SILENT,
) -> BenchTryonResult:
    """Render every variant of the outfit with the truth's cameras, and score it.

    Raises:
        UsageProblem: no such variant or region. MissingInput: a file is absent, or the truth has no labels.
    """
    unknown = [name for name in config.variants if name not in VARIANTS]
    if unknown:
        raise UsageProblem(
            f"There is no variant {unknown[0]!r}.",
            "option --variants",
            "Choose of: " + ", ".join(VARIANTS) + ".",
        )
    started = time.monotonic()
    check_output(output, RESULT_NAME, MARK)
    named = read_bundles(bundles)
    region = config.region or _foreign_garment([bundle for _, bundle in named])
    outfits = {
        parts: outfit_of_bundles(
            named, swap="swap" in parts, push="push" in parts, restore="restore" in parts
        )
        for parts in {tuple(p for p in VARIANTS[name] if p != "penetration") for name in config.variants}
    }
    take = capture_take(open_capture(truth), None)
    poses = load_poses(poses_path, next(iter(outfits.values())).body_model)
    frames = capture_frames(take)[:: config.frame_step]
    rows: list[dict[str, Any]] = []
    report.step(f"scoring {len(config.variants)} variants, region {region}")
    with output_folder(output, RESULT_NAME, MARK) as folder:
        pictured = chosen(len(frames), config.pictures)
        for index, frame in enumerate(frames):
            composites = {parts: outfit.composite(poses, frame.row) for parts, outfit in outfits.items()}
            cameras = frame.cameras[:: config.camera_step]
            for camera in cameras:
                views = {}
                for name in config.variants:
                    parts = VARIANTS[name]
                    composite = composites[tuple(p for p in parts if p != "penetration")]
                    shot = render_image(composite, camera, TRYON_MARGINS if "penetration" in parts else None)
                    views[name] = _pair(shot, take, camera, frame.row)
                    scores = tryon_scores(views[name], label_of(region))
                    rows.append({"variant": name, "frame": frame.row, "camera": camera.name, **scores})
                if index in pictured and camera is cameras[0]:
                    picture = _comparison(views)
                    write_file(folder / f"compare_{pictured.index(index)}.png", encode_png(picture))
            report.progress(index + 1, len(frames))
        summary = _summary(rows, config, region)
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_file(folder / "views.json", readable_json({"views": rows}))
        write_file(folder / "table.md", markdown(summary["variants"]).encode())
        content = {"format": MARK, "version": 1, "config": asdict(config), **summary}
        write_file(folder / RESULT_NAME, readable_json(content))
    return BenchTryonResult(output, summary)


def markdown(variants: dict[str, Scores]) -> str:
    """The means as a table, one variant a row."""
    lines = ["| | " + " | ".join(NAMES) + " |", "|---|" + "---:|" * len(NAMES)]
    for name, scores in variants.items():
        cells = ["–" if (value := scores[key]) is None else _rounded(key, value) for key in NAMES]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _summary(rows: list[dict[str, Any]], config: BenchTryonConfig, region: str) -> dict[str, Any]:
    variants = {name: means([row for row in rows if row["variant"] == name]) for name in config.variants}
    return {
        "region": region,
        "views": len(rows) // len(config.variants),
        "variants": variants,
        "helps": _helps(variants),
    }


def _helps(variants: dict[str, Scores]) -> dict[str, dict[str, Scores]]:
    """Of every part: what it changes when it is added to nothing, and to all the others."""

    def change(after: str, before: str) -> Scores:
        pairs = ((name, variants[after][name], variants[before][name]) for name in NAMES)
        return {name: None if a is None or b is None else round(a - b, 6) for name, a, b in pairs}

    found: dict[str, dict[str, Scores]] = {}
    for part in PARTS:
        others = f"all but {part}"
        if {"none", part} <= variants.keys():
            found.setdefault(part, {})["alone"] = change(part, "none")
        if {"all", others} <= variants.keys():
            found.setdefault(part, {})["on top of the others"] = change("all", others)
    return found


def _foreign_garment(bundles: list[Bundle]) -> str:
    """The garment that was not learned on the body: what a try-on is about."""
    own = next(
        (b.manifest["training"].get("source") for b in bundles if b.kind == "body"),
        None,
    )
    garments = [bundle for bundle in bundles if bundle.kind == "garment"]
    if not garments:
        raise UsageProblem("There is no garment.", "bundles", "Name a garment to be scored.")
    foreign = [bundle for bundle in garments if bundle.manifest["training"].get("source") != own]
    return (foreign or garments)[0].layer


def _pair(shot: Any, take: Take, camera: Camera, row: int) -> ViewPair:
    labels = take.labels(camera.name, row)
    if labels is None:
        raise MissingInput("The truth has no label images.", take.name, "Give a capture with labels.")
    prediction = shot.on((0.0, 0.0, 0.0))
    mask = take.mask(camera.name, row)
    return ViewPair(prediction, shot.alpha, take.image(camera.name, row), mask, shot.labels, labels)


def _comparison(views: dict[str, ViewPair]) -> NDArray[np.uint8]:
    """The truth and every variant, with where the body shows in a garment's place painted red."""
    truth = next(iter(views.values()))
    pictures, captions = [truth.truth], ["truth"]
    for name, view in views.items():
        picture = view.prediction.copy()
        assert view.truth_labels is not None and view.prediction_labels is not None
        body_shows = np.isin(view.prediction_labels, BODY_LABELS)
        picture[np.isin(view.truth_labels, GARMENT_LABELS) & body_shows] = (255, 0, 0)
        pictures.append(picture)
        captions.append(name)
    rows, columns = np.nonzero(truth.mask > MASK_THRESHOLD)
    cut = np.s_[max(rows.min() - 8, 0) : rows.max() + 9, max(columns.min() - 16, 0) : columns.max() + 17]
    cells = [shrunk(np.ascontiguousarray(picture[cut]), 384) for picture in pictures]
    return contact_sheet(cells, 6, captions)


def _rounded(name: str, value: float) -> str:
    return f"{value:.2f}" if "psnr" in name or name == "skin_through" else f"{value:.4f}"

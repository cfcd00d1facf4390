"""Score rendered frames against a capture that shows the same: `gw evaluate --frames DIR --truth CAPTURE`.

Reads:
    DIR of `gw render --cameras CAPTURE`: result.json; frames/CAMERA/RRRRRR.png (H,W,4) u8 sRGB, straight
    alpha, labels/CAMERA/RRRRRR.png (H,W) u8. The capture: images, masks, labels of the same frames.
Writes, into the output folder:
    evaluation.json: {"tryon_truth": {score: mean}, "tryon_truth_without_first": …}; views.json;
    tryon_truth_<n>.png.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.result import MARK, RESULT_NAME, EvaluateResult, write_evaluation
from stages.evaluate.score_table import ScoredView, ScoreTable, pair_items
from stages.evaluate.sharding import (
    collect_rows,
    evaluation_key,
    score_items,
    shard_summary,
)
from stages.shared.capture import Take, open_capture
from stages.shared.capture.images import decode, read_bytes
from stages.shared.capture.labels import read_labels
from stages.shared.errors import BadData, MissingInput
from stages.shared.input_files import read_json
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import ViewPair
from stages.shared.outfit.sources import capture_take
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report

_SPLIT = "tryon_truth"


def run(
    frames: Path,
    truth: Path,
    output: Path,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
) -> EvaluateResult:
    """Score every picture of `frames` that the capture `truth` also has.

    Raises:
        MissingInput: nothing in common, or no such folder. BadData: pictures of another size, damaged files.
    """
    started, share = time.monotonic(), parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    shown, take, pairs = _opened(frames, truth)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None

    def scored(index: int) -> ScoredView:
        row, camera = pairs[index]
        view = _pair(frames, take, camera, row)
        return ScoredView("tryon", take.name, camera, row, row == shown["frames"][0], view)

    items = pair_items(_SPLIT, len(pairs), scored, perceptual, config.pictures)
    files = [path for row, camera in pairs for path in _files(frames, take, camera, row)]
    report.step("scoring")
    key = evaluation_key(config, {"take": take.name, "pairs": pairs}, files, perceptual_weights)
    with part_folder(output, key, share) as folder:
        already_scored = score_items(folder, items, share, report)
        if not share.whole:
            return EvaluateResult(output, shard_summary(items, config.shard, already_scored), False)
        rows = collect_rows(folder, items)
        means = ScoreTable(rows=rows[_SPLIT]).means()
        summary: dict[str, Any] = {_SPLIT: means["tryon"]}
        if "tryon_without_first" in means:
            summary[f"{_SPLIT}_without_first"] = means["tryon_without_first"]
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_evaluation(folder, config, summary, rows, perceptual_weights)
        finish(folder, output, [])
    return EvaluateResult(output, summary)


def plan(
    frames: Path,
    truth: Path,
    output: Path,
    config: EvaluateConfig = EvaluateConfig(),
    perceptual_weights: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    share = parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    _, _, pairs = _opened(frames, truth)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    given = [str(frames), str(truth)]
    return Plan(given, [str(output / RESULT_NAME)], {"pictures": len(share.of(pairs))})


def _opened(frames: Path, truth: Path) -> tuple[dict[str, Any], Take, list[tuple[int, str]]]:
    """What the render wrote about itself, the take, row and camera of every picture that both have."""
    shown = _rendered(frames)
    take = capture_take(open_capture(truth), shown.get("take"))
    names = set(take.cameras)
    pairs = [(row, camera) for row in shown["frames"] for camera in shown["cameras"] if camera in names]
    pairs = [(row, camera) for row, camera in pairs if take.has_image(camera, row)]
    if not pairs:
        raise MissingInput(
            "The rendered frames and the capture have no picture in common.",
            f"{frames}, {truth}",
            f"Render with the capture's cameras: gw render … --cameras {truth}.",
        )
    return shown, take, pairs


def _files(frames: Path, take: Take, camera: str, row: int) -> list[Path]:
    """What one pair is read from."""
    view = take.view(camera, row)
    labels = frames / "labels" / camera / f"{row:06d}.png"
    found = [frames / "frames" / camera / f"{row:06d}.png", view.image, view.mask, view.labels]
    return [path for path in (*found, labels if labels.is_file() else None) if path is not None]


def _rendered(frames: Path) -> dict[str, Any]:
    """What the render wrote about itself."""
    path = frames / "result.json"
    if not path.is_file():
        raise MissingInput(
            "This is not a folder of rendered frames.",
            str(path),
            "Make one: gw render … --cameras CAPTURE -o DIR.",
        )
    shown = read_json(path, "the result of a render")
    cameras = shown.get("cameras") if isinstance(shown, dict) else None
    rows = shown.get("frames") if isinstance(shown, dict) else None
    whole = isinstance(cameras, list) and all(isinstance(name, str) for name in cameras)
    if not whole or not isinstance(rows, list) or not all(type(row) is int and row >= 0 for row in rows):
        raise BadData("It does not list frames and cameras.", str(path), "Render with --cameras CAPTURE.")
    if not shown.get("camera_folders"):
        raise BadData(
            "These frames were not rendered with a capture's cameras.",
            str(path),
            "Render with --cameras CAPTURE.",
        )
    return dict(shown)


def _pair(frames: Path, take: Take, camera: str, row: int) -> ViewPair:
    """A rendered picture and the true one."""
    path = frames / "frames" / camera / f"{row:06d}.png"
    picture = decode(read_bytes(path), path, cv2.IMREAD_UNCHANGED)
    if picture.ndim != 3 or picture.shape[2] != 4:
        raise BadData("The frame has no alpha channel.", str(path), "Render again with gw render.")
    truth = take.image(camera, row)
    if picture.shape[:2] != truth.shape[:2]:
        raise BadData(
            f"The frame has {picture.shape[1]} x {picture.shape[0]} pixels, the truth {truth.shape[1]} x "
            f"{truth.shape[0]}.",
            str(path),
            "Render again with the cameras of this capture.",
        )
    alpha = (picture[..., 3] / 255).astype(np.float32)
    on_black = np.rint(picture[..., 2::-1] * alpha[..., None]).astype(np.uint8)
    labels_path = frames / "labels" / camera / f"{row:06d}.png"
    labels = read_labels(labels_path) if labels_path.is_file() else None
    return ViewPair(on_black, alpha, truth, take.mask(camera, row), labels, take.labels(camera, row))

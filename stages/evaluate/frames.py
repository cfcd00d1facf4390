"""Source of an evaluation: rendered frames and a capture that shows the same.

`gw evaluate --frames DIR --truth CAPTURE`

Reads:
    DIR of `gw render --cameras CAPTURE`: result.json; frames/CAMERA/RRRRRR.png (H,W,4) u8 sRGB, straight
    alpha, labels/CAMERA/RRRRRR.png (H,W) u8. The capture: images, masks, labels of the same frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.score_table import ScoredView, ScoreTable, pair_items
from stages.evaluate.sharding import (
    RESULT_NAME,
    Row,
    WorkItem,
)
from stages.evaluate.source import Source
from stages.shared.capture import Take, open_capture
from stages.shared.capture.images import decode, read_bytes
from stages.shared.capture.labels import read_labels
from stages.shared.errors import BadData, MissingInput
from stages.shared.input_files import read_json
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import ViewPair
from stages.shared.outfit.sources import capture_take
from stages.shared.pictures.parts import Share
from stages.shared.plan import Plan
from stages.shared.report import Report

_SPLIT = "tryon_truth"


@dataclass(frozen=True, eq=False)
class FramesSource(Source):
    """What the render wrote about itself, the take, and row and camera of every picture that both have."""

    frames: Path
    truth: Path
    config: EvaluateConfig
    description: dict[str, Any]
    take: Take
    pairs: list[tuple[int, str]]

    @classmethod
    def open(cls, frames: Path, truth: Path, config: EvaluateConfig) -> FramesSource:
        """Rendered frames and the capture that shows the same.

        Raises:
            MissingInput: nothing in common. BadData: the folder does not describe its frames.
        """
        description = _description(frames)
        take = capture_take(open_capture(truth), description.get("take"))
        names = set(take.cameras)
        pairs = [(row, name) for row in description["frames"] for name in description["cameras"]]
        pairs = [(row, name) for row, name in pairs if name in names and take.has_image(name, row)]
        if not pairs:
            raise MissingInput(
                "The rendered frames and the capture have no picture in common.",
                f"{frames}, {truth}",
                f"Render with the capture's cameras: gw render … --cameras {truth}.",
            )
        return cls(frames, truth, config, description, take, pairs)

    def identity(self) -> tuple[dict[str, Any], list[Path]]:
        files = [path for row, camera in self.pairs for path in _files(self.frames, self.take, camera, row)]
        return {"take": self.take.name, "pairs": self.pairs}, files

    def items(self, perceptual: Perceptual | None) -> list[WorkItem]:
        first = self.description["frames"][0]

        def read(index: int) -> ScoredView:
            row, camera = self.pairs[index]
            view = _pair(self.frames, self.take, camera, row)
            return ScoredView("tryon", self.take.name, camera, row, row == first, view)

        return pair_items(_SPLIT, len(self.pairs), read, perceptual, self.config.pictures)

    def summary(self, rows: dict[str, list[Row]], folder: Path, report: Report) -> dict[str, Any]:
        means = ScoreTable(rows=rows[_SPLIT]).means()
        summary: dict[str, Any] = {_SPLIT: means["tryon"]}
        if "tryon_without_first" in means:
            summary[f"{_SPLIT}_without_first"] = means["tryon_without_first"]
        return summary

    def plan(self, output: Path, share: Share) -> Plan:
        pictures = {"pictures": len(share.of(self.pairs))}
        return Plan([str(self.frames), str(self.truth)], [str(output / RESULT_NAME)], pictures)


def _files(frames: Path, take: Take, camera: str, row: int) -> list[Path]:
    """What one pair is read from."""
    view = take.view(camera, row)
    labels = frames / "labels" / camera / f"{row:06d}.png"
    paths = [frames / "frames" / camera / f"{row:06d}.png", view.image, view.mask, view.labels]
    return [path for path in (*paths, labels if labels.is_file() else None) if path is not None]


def _description(frames: Path) -> dict[str, Any]:
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

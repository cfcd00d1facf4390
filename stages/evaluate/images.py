"""Source of an evaluation: plain folders of pictures.

`gw evaluate --images DIR --truth DIR [--masks DIR]`

Reads:
    pictures (PNG, JPEG) of both folders, at any depth, paired by path without suffix: sRGB, or RGBA with
    straight alpha. Masks (H,W) of the same names, if given; else the alpha of the truth.

Without any mask there is no foreground: its scores are null, and the whole picture is scored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.score_table import ScoredView, ScoreTable, pair_items
from stages.evaluate.sharding import (
    RESULT_NAME,
    Row,
    WorkItem,
)
from stages.evaluate.source import Source
from stages.shared.capture.images import decode, read_bytes, read_mask
from stages.shared.errors import BadData, MissingInput
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import FOREGROUND_NAMES, ViewPair
from stages.shared.pictures.parts import Share
from stages.shared.plan import Plan
from stages.shared.report import Report

_SUFFIXES = (".png", ".jpg", ".jpeg")
_SPLIT = "images"


@dataclass(frozen=True, eq=False)
class ImagesSource(Source):
    """Name, picture and truth of every pair, and the masks by name, if there are any."""

    images: Path
    truth: Path
    mask_folder: Path | None
    config: EvaluateConfig
    pairs: list[tuple[str, Path, Path]]
    masks: dict[str, Path] | None

    @classmethod
    def open(cls, images: Path, truth: Path, masks: Path | None, config: EvaluateConfig) -> ImagesSource:
        """Two folders of pictures.

        Raises:
            MissingInput: no pair, or a mask that is not there.
        """
        pairs = paired(images, truth)
        mask_files = pictures_of(masks) if masks is not None else None
        lacking = [] if mask_files is None else [pair for pair in pairs if pair[0] not in mask_files]
        for name, _, true in lacking:
            raise MissingInput(f"There is no mask for {name}.", str(true), "Give a mask for every picture.")
        return cls(images, truth, masks, config, pairs, mask_files)

    def identity(self) -> tuple[dict[str, Any], list[Path]]:
        masks = self.masks or {}
        files = [path for _, *both in self.pairs for path in both] + list(masks.values())
        return {"pictures": [name for name, *_ in self.pairs], "masks": list(masks)}, files

    def items(self, perceptual: Perceptual | None) -> list[WorkItem]:
        def read(index: int) -> ScoredView:
            view, has_mask = _view(*self.pairs[index], self.masks)
            unknown = () if has_mask else FOREGROUND_NAMES
            return ScoredView(_SPLIT, "", self.pairs[index][0], index, False, view, unknown)

        return pair_items(_SPLIT, len(self.pairs), read, perceptual, self.config.pictures)

    def summary(self, rows: dict[str, list[Row]], folder: Path, report: Report) -> dict[str, Any]:
        unmatched = len(set(pictures_of(self.images)) ^ set(pictures_of(self.truth)))
        return {_SPLIT: ScoreTable(rows=rows[_SPLIT]).means()[_SPLIT], "unmatched": unmatched}

    def plan(self, output: Path, share: Share) -> Plan:
        inputs = [str(path) for path in (self.images, self.truth, self.mask_folder) if path is not None]
        return Plan(inputs, [str(output / RESULT_NAME)], {"pictures": len(share.of(self.pairs))})


def pictures_of(folder: Path) -> dict[str, Path]:
    """Pictures of a folder at any depth, by path without suffix, sorted."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}


def paired(images: Path, truth: Path) -> list[tuple[str, Path, Path]]:
    """Name, picture and truth of what both folders have. Raises MissingInput where that is nothing."""
    for folder in (images, truth):
        if not folder.is_dir():
            raise MissingInput("There is no such folder of pictures.", str(folder), "Check the path.")
    predicted, true = pictures_of(images), pictures_of(truth)
    names = [name for name in predicted if name in true]
    if not names:
        raise MissingInput(
            "The two folders have no picture of the same name.",
            f"{images} ({len(predicted)} pictures), {truth} ({len(true)} pictures)",
            "Name the pictures alike; suffixes may differ (.png, .jpg).",
        )
    return [(name, predicted[name], true[name]) for name in names]


def _view(name: str, predicted: Path, true: Path, masks: dict[str, Path] | None) -> tuple[ViewPair, bool]:
    """One pair, and whether there is a mask."""
    picture, alpha = _read(predicted)
    truth, mask = _read(true)
    if masks is not None:
        mask = read_mask(masks[name])
    for path, other in ((predicted, picture), (masks[name] if masks else true, mask)):
        if other is not None and other.shape[:2] != truth.shape[:2]:
            raise BadData(
                f"It has {other.shape[1]} x {other.shape[0]} pixels, the truth {truth.shape[1]} x "
                f"{truth.shape[0]}.",
                str(path),
                "Give pictures of one size.",
            )
    whole = np.full(truth.shape[:2], 255, np.uint8)
    alpha = whole if alpha is None else alpha
    cover = whole if mask is None else mask
    return ViewPair(picture, (alpha / 255).astype(np.float32), truth, cover), mask is not None


def _read(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Picture (H, W, 3) u8 sRGB, on black where it is transparent, and its alpha (H, W), if it has one."""
    pixels = decode(read_bytes(path), path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2), None
    color = np.ascontiguousarray(pixels[..., 2::-1])
    if pixels.shape[2] == 3:
        return color, None
    alpha = np.ascontiguousarray(pixels[..., 3])
    return np.rint(color * (alpha[..., None] / 255)).astype(np.uint8), alpha

"""Score plain folders of pictures: `gw evaluate --images DIR --truth DIR [--masks DIR]`.

Reads:
    pictures (PNG, JPEG) of both folders, at any depth, paired by path without suffix: sRGB, or RGBA with
    straight alpha. Masks (H,W) of the same names, if given; else the alpha of the truth.
Writes, into the output folder:
    evaluation.json: {"images": {score: mean}}; views.json; images_<n>.png: truth, prediction, error.

Without any mask there is no foreground: its scores are null, and the whole picture is scored.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.result import MARK, RESULT_NAME, EvaluateResult, write_evaluation
from stages.evaluate.score_table import ScoredView, ScoreTable, pair_items
from stages.evaluate.sharding import (
    collect_rows,
    evaluation_key,
    score_items,
    shard_summary,
)
from stages.shared.capture.images import decode, read_bytes, read_mask
from stages.shared.errors import BadData, MissingInput
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import FOREGROUND_NAMES, ViewPair
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report

_SUFFIXES = (".png", ".jpg", ".jpeg")
_SPLIT = "images"


def run(
    images: Path,
    truth: Path,
    output: Path,
    masks: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
) -> EvaluateResult:
    """Score every picture of `images` that `truth` also has.

    Raises:
        MissingInput: no pair, or a mask that is not there. BadData: another size, damaged files.
    """
    started, share = time.monotonic(), parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    pairs, covers = _opened(images, truth, masks)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    items = pair_items(
        _SPLIT, len(pairs), lambda index: _scored(pairs[index], covers, index), perceptual, config.pictures
    )
    files = [path for _, *both in pairs for path in both] + list((covers or {}).values())
    names = {"pictures": [name for name, *_ in pairs], "masks": list(covers or ())}
    report.step("scoring")
    with part_folder(output, evaluation_key(config, names, files, perceptual_weights), share) as folder:
        already_scored = score_items(folder, items, share, report)
        if not share.whole:
            return EvaluateResult(output, shard_summary(items, config.shard, already_scored), False)
        rows = collect_rows(folder, items)
        summary: dict[str, Any] = {_SPLIT: ScoreTable(rows=rows[_SPLIT]).means()["images"]}
        summary["unmatched"] = len(set(pictures_of(images)) ^ set(pictures_of(truth)))
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_evaluation(folder, config, summary, rows, perceptual_weights)
        finish(folder, output, [])
    return EvaluateResult(output, summary)


def plan(
    images: Path,
    truth: Path,
    output: Path,
    masks: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    perceptual_weights: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    share = parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    pairs, _ = _opened(images, truth, masks)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    given = [str(path) for path in (images, truth, masks) if path is not None]
    return Plan(given, [str(output / RESULT_NAME)], {"pictures": len(share.of(pairs))})


def _opened(
    images: Path, truth: Path, masks: Path | None
) -> tuple[list[tuple[str, Path, Path]], dict[str, Path] | None]:
    """The pairs, and the masks by name."""
    pairs = paired(images, truth)
    if masks is None:
        return pairs, None
    covers = pictures_of(masks)
    for name, _, true in pairs:
        if name not in covers:
            raise MissingInput(f"There is no mask for {name}.", str(true), "Give a mask for every picture.")
    return pairs, covers


def _scored(pair: tuple[str, Path, Path], covers: dict[str, Path] | None, index: int) -> ScoredView:
    view, has_mask = _view(*pair, covers)
    return ScoredView("images", "", pair[0], index, False, view, () if has_mask else FOREGROUND_NAMES)


def pictures_of(folder: Path) -> dict[str, Path]:
    """Pictures of a folder at any depth, by path without suffix, sorted."""
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in found}


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


def _view(name: str, predicted: Path, true: Path, covers: dict[str, Path] | None) -> tuple[ViewPair, bool]:
    """One pair, and whether there is a mask."""
    picture, alpha = _read(predicted)
    truth, mask = _read(true)
    if covers is not None:
        mask = read_mask(covers[name])
    for path, other in ((predicted, picture), (covers[name] if covers else true, mask)):
        if other is not None and other.shape[:2] != truth.shape[:2]:
            raise BadData(
                f"It has {other.shape[1]} x {other.shape[0]} pixels, the truth {truth.shape[1]} x "
                f"{truth.shape[0]}.",
                str(path),
                "Give pictures of one size.",
            )
    whole = np.full(truth.shape[:2], 255, np.uint8)
    covered = whole if alpha is None else alpha
    cover = whole if mask is None else mask
    return ViewPair(picture, (covered / 255).astype(np.float32), truth, cover), mask is not None


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

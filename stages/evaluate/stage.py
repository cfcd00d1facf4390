"""Evaluate: score pictures against their truth. A trained subject, rendered frames, or any pictures.

Reads:
    what the source names: `subject.py`, `frames.py`, `images.py`.
Writes, into the output folder:
    evaluation.json: means by split and method, {"novel_pose": {"trained": {score: mean},
    "trained_without_first": …, "baseline": …}, …}. Rendered frames have the split "tryon_truth", pictures
    the split "images". With true meshes, "vertex_error" (`vertices.py`).
    views.json: the scores of every view. <split>_<n>.png: truth, renders, errors, labels.
    vertices.json: with true meshes, by frame.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.evaluate.config import EvaluateConfig, EvaluateInputs, check_inputs, default_output
from stages.evaluate.frames import FramesSource
from stages.evaluate.images import ImagesSource
from stages.evaluate.sharding import (
    MARK,
    RESULT_NAME,
    collect_rows,
    evaluation_key,
    score_items,
    shard_summary,
)
from stages.evaluate.source import Source
from stages.evaluate.subject import SubjectSource
from stages.shared.artifacts.canonical import readable_json, to_json
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.files import write_whole
from stages.shared.losses.perceptual import Perceptual
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report


@dataclass(frozen=True)
class EvaluateResult:
    """The folder, and the means. complete: the folder has its name; false after a shard."""

    path: Path
    summary: dict[str, Any]
    complete: bool = True


def run(
    inputs: EvaluateInputs,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
) -> EvaluateResult:
    """Score all views of the inputs, or one shard of them. LPIPS needs its weights.

    Raises:
        UsageProblem: inputs or settings that are not clear. MissingInput: a stage has not run, or nothing can
        be compared. BadData: damaged files, or pictures of another size.
    """
    started, share = time.monotonic(), parse_share(config.shard)
    source = open_source(inputs, config)
    output = output or default_output(inputs)
    check_output(output, RESULT_NAME, MARK)
    items = source.items(Perceptual.load(perceptual_weights) if perceptual_weights else None)
    report.step("scoring")
    key = evaluation_key(config, *source.identity(), perceptual_weights)
    with part_folder(output, key, share) as folder:
        already_scored = score_items(folder, items, share, report)
        if not share.whole:
            return EvaluateResult(output, shard_summary(items, config.shard, already_scored), False)
        rows = collect_rows(folder, items)
        summary = source.summary(rows, folder, report)
        summary["seconds"] = round(time.monotonic() - started, 1)
        _write(folder, config, summary, rows, perceptual_weights)
        finish(folder, output, [])
    return EvaluateResult(output, summary)


def plan(
    inputs: EvaluateInputs,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    perceptual_weights: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    source = open_source(inputs, config)
    output = output or default_output(inputs)
    check_output(output, RESULT_NAME, MARK)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    return source.plan(output, parse_share(config.shard))


def open_source(inputs: EvaluateInputs, config: EvaluateConfig) -> Source:
    """The source that the inputs name.

    Raises:
        UsageProblem: as `check_inputs`; settings that do not fit. MissingInput, BadData: as the sources.
    """
    check_inputs(inputs)
    if inputs.subject is not None:
        return SubjectSource.open(inputs.subject, config, inputs.true_meshes)
    assert inputs.truth is not None
    if inputs.frames is not None:
        return FramesSource.open(inputs.frames, inputs.truth, config)
    assert inputs.images is not None
    return ImagesSource.open(inputs.images, inputs.truth, inputs.masks, config)


def _write(
    folder: Path,
    config: EvaluateConfig,
    summary: dict[str, Any],
    rows: dict[str, Any],
    perceptual_weights: Path | None,
) -> None:
    """Write means and the scores of every view. Perceptual weights are named by their digest."""
    write_whole(folder / "views.json", readable_json(rows))
    content = {"format": MARK, "version": 1, "config": to_json(config), **summary}
    if perceptual_weights:
        content["perceptual_digest"] = file_digest(perceptual_weights)
    write_whole(folder / RESULT_NAME, readable_json(content))

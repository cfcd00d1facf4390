"""What every kind of evaluation leaves: a folder with evaluation.json and views.json, marked as such."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.evaluate.config import EvaluateConfig
from stages.shared.artifacts.canonical import plain, readable_json
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.files import write_whole

MARK = "gw-evaluation"
RESULT_NAME = "evaluation.json"


@dataclass(frozen=True)
class EvaluateResult:
    """The folder, and the means. complete: the folder has its name; false after a shard."""

    path: Path
    summary: dict[str, Any]
    complete: bool = True


def write_evaluation(
    folder: Path,
    config: EvaluateConfig,
    summary: dict[str, Any],
    rows: dict[str, Any],
    perceptual_weights: Path | None = None,
) -> None:
    """Write means and the scores of every view; the perceptual weights are named by their digest."""
    write_whole(folder / "views.json", readable_json(rows))
    content = {"format": MARK, "version": 1, "config": plain(config), **summary}
    if perceptual_weights:
        content["perceptual_digest"] = file_digest(perceptual_weights)
    write_whole(folder / RESULT_NAME, readable_json(content))

"""An evaluation in shards, which can be interrupted and continued.

The folder `.OUT.part-KEY` next to the output holds a record of every scored frame. The record contains the
rows of the frame and is written after its pictures. KEY is a digest of everything that determines the scores,
with the pixels of the truth.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.evaluate.config import EvaluateConfig
from stages.shared.artifacts.canonical import KEY_LENGTH, canonical_json, digest
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.files import make_folders, write_file, write_whole
from stages.shared.pictures.parts import RECORDS, Share, parse_share
from stages.shared.report import Report

MARK = "gw-evaluation"
RESULT_NAME = "evaluation.json"
_CODE_VERSION = 2  # raised when the same inputs give other scores
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class WorkItem:
    """A frame to score.

    Attributes:
        split: of views.json. score: returns the rows, and writes pictures into the folder of its argument.
    """

    split: str
    score: Callable[[Path], list[Row]]


def evaluation_key(
    config: EvaluateConfig, sources: Mapping[str, Any], files: Iterable[Path], weights: Path | None
) -> str:
    """Digest that names the content of an evaluation: equal keys mean equal scores.

    Arguments:
        sources: identifies artifacts and views. files: the truth and what is scored; their content counts,
            not their paths. weights: of LPIPS.
    """
    parts = {
        "code": _CODE_VERSION,
        "config": config,
        "sources": sources,
        "files": [file_digest(path) for path in files],
        "weights": file_digest(weights) if weights else None,
    }
    return digest(canonical_json(parts))[:KEY_LENGTH]


def score_items(folder: Path, items: Sequence[WorkItem], share: Share, report: Report) -> int:
    """Score a share of the items, without those already scored; returns the number of the latter."""
    numbers = share.of(range(len(items)))
    missing = [number for number in numbers if not _record(folder, number).exists()]
    make_folders(folder / RECORDS)
    for done, number in enumerate(missing):
        rows = items[number].score(folder)
        write_whole(_record(folder, number), json.dumps(rows, allow_nan=False).encode())
        report.progress(done + 1, len(missing))
    already_scored = len(numbers) - len(missing)
    if already_scored:
        report.say(f"{already_scored} of {len(numbers)} were scored already")
    return already_scored


def shard_summary(items: Sequence[WorkItem], shard: str, already_scored: int) -> dict[str, Any]:
    """Summary of a run that scored one shard."""
    return {"shard": shard, "frames": len(parse_share(shard).of(items)), "kept": already_scored}


def collect_rows(folder: Path, items: Sequence[WorkItem]) -> dict[str, list[Row]]:
    """The rows of every split, in the order of the items, all of which are scored."""
    rows: dict[str, list[Row]] = {}
    for number, item in enumerate(items):
        rows.setdefault(item.split, []).extend(json.loads(_record(folder, number).read_bytes()))
    return rows


def replace_picture(path: Path, data: bytes) -> None:
    """Write a picture over one that an interrupted run may have left unfinished."""
    path.unlink(missing_ok=True)
    write_file(path, data)


def _record(folder: Path, number: int) -> Path:
    return folder / RECORDS / f"{number:06d}.json"

"""An evaluation in parts: frames that are scored are kept, by shards or after a kill, then gathered.

Beside the output stands `.OUT.part-KEY` with a record of every frame that was scored (its rows, written after
its pictures); KEY is a digest of everything that the scores follow from, the pixels of the truth included.
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

_CODE_VERSION = 1  # raised when the same inputs give other scores
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Piece:
    """A frame to score.

    Attributes:
        split: of views.json. score: makes the rows, and writes pictures into the folder it is given.
    """

    split: str
    score: Callable[[Path], list[Row]]


def evaluation_key(
    config: EvaluateConfig, sources: Mapping[str, Any], files: Iterable[Path], weights: Path | None
) -> str:
    """Names the content of an evaluation: the same key, the same scores.

    Arguments:
        sources: what tells artifacts and views. files: of the truth and of what is scored; their content
            counts, not where they are. weights: of LPIPS.
    """
    parts = {
        "code": _CODE_VERSION,
        "config": config,
        "sources": sources,
        "files": [file_digest(path) for path in files],
        "weights": file_digest(weights) if weights else None,
    }
    return digest(canonical_json(parts))[:KEY_LENGTH]


def score_pieces(folder: Path, pieces: Sequence[Piece], share: Share, report: Report) -> int:
    """Score a share of the pieces, those already scored left out; returns how many were left out."""
    numbers = share.of(range(len(pieces)))
    missing = [number for number in numbers if not _record(folder, number).exists()]
    make_folders(folder / RECORDS)
    for done, number in enumerate(missing):
        rows = pieces[number].score(folder)
        write_whole(_record(folder, number), json.dumps(rows, allow_nan=False).encode())
        report.progress(done + 1, len(missing))
    if kept := len(numbers) - len(missing):
        report.say(f"{kept} of {len(numbers)} were scored already")
    return len(numbers) - len(missing)


def part_summary(pieces: Sequence[Piece], shard: str, kept: int) -> dict[str, Any]:
    """The summary of a run that scored a part."""
    return {"shard": shard, "frames": len(parse_share(shard).of(pieces)), "kept": kept}


def gathered_rows(folder: Path, pieces: Sequence[Piece]) -> dict[str, list[Row]]:
    """The rows of every split, in the order of the pieces, all of which are scored."""
    rows: dict[str, list[Row]] = {}
    for number, piece in enumerate(pieces):
        rows.setdefault(piece.split, []).extend(json.loads(_record(folder, number).read_bytes()))
    return rows


def replace_picture(path: Path, data: bytes) -> None:
    """Write a picture, in the place of one that a kill may have left unfinished."""
    path.unlink(missing_ok=True)
    write_file(path, data)


def _record(folder: Path, number: int) -> Path:
    return folder / RECORDS / f"{number:06d}.json"

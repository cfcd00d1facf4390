"""The paper's three tables, with rows of one's own: novel pose, novel view, ablation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from stages.workflows.paper.published import ABLATION, METHODS, NOVEL_POSE, NOVEL_VIEW, PublishedRow

_PICTURES = ("psnr", "ssim", "lpips", "psnr_foreground", "ssim_foreground", "flip", "iou", "sharpness")
_LABELS = ("miou", "recall", "f1")
_TITLES = {"novel_pose": "Novel pose", "novel_view": "Novel view", "ablation": "Ablation: label pictures"}
_PLACES = {"psnr": 2, "psnr_foreground": 2, "sharpness": 2}


@dataclass(frozen=True)
class OwnRow:
    """A training of a subject and its means by split ("novel_pose", "novel_view"; a split may be missing).

    Attributes:
        subject, key, method, without: which training. minutes: it took. steps: it made.
        scores: split to score name to value or None, without the first frame where there are others.
        budget: minutes that it was given; 0 where steps ended it, None where it is not known.
    """

    subject: str
    key: str
    method: str
    without: tuple[str, ...]
    minutes: float | None
    steps: int | None
    scores: dict[str, dict[str, float | None]] = field(default_factory=dict)
    budget: float | None = None


def tables(rows: list[OwnRow]) -> dict[str, list[dict[str, Any]]]:
    """Rows of the tables "novel_pose", "novel_view" and "ablation": published ones first.

    Rows of one subject and budget stand together. Ablations are scored on novel poses, where there are some,
    else on novel views; beside them stands the whole method where it had their budget.
    """
    rows = sorted(rows, key=lambda row: (row.subject, row.budget or 0.0))  # stable: methods keep their order
    full = [row for row in rows if not row.without]
    budgets = {(row.subject, row.budget) for row in rows if row.without}
    own = [row for row in rows if row.method == "gaussian-wardrobe"]
    own = [row for row in own if row.without or not budgets or (row.subject, row.budget) in budgets]
    return {
        "novel_pose": [
            *map(_published, NOVEL_POSE),
            *(_own(row, ("novel_pose",), _PICTURES) for row in full),
        ],
        "novel_view": [
            *map(_published, NOVEL_VIEW),
            *(_own(row, ("novel_view",), _PICTURES) for row in full),
        ],
        "ablation": [
            *map(_published, ABLATION),
            *(
                _own(row, ("novel_pose", "novel_view"), (*_LABELS, "psnr_foreground", "ssim_foreground"))
                for row in sorted(own, key=_ablation_order)
            ),
        ],
    }


def _ablation_order(row: OwnRow) -> tuple[str, float, bool, tuple[str, ...]]:
    return row.subject, row.budget or 0.0, not row.without, row.without


def markdown(found: dict[str, list[dict[str, Any]]]) -> str:
    """The tables as text; "–" where a score is not known."""
    parts = [
        "Published rows (Gaussian Wardrobe) are of 4D-DRESS and ActorsHQ, trained for days on a GPU: other "
        "data than the rows below them, which say how long they were trained. psnr and ssim are over the "
        "whole picture, white outside the mask; psnr_foreground, ssim_foreground and flip are of the subject "
        "alone.\n"
    ]
    for name, rows in found.items():
        scores = [score for score in (*_PICTURES, *_LABELS) if any(score in row["scores"] for row in rows)]
        if name == "ablation":
            scores = [*_LABELS, *(score for score in scores if score not in _LABELS)]
        parts.append(f"### {_TITLES[name]}\n")
        parts.append("| data | method | without | training | minutes | " + " | ".join(scores) + " |")
        parts.append("| --- " * (5 + len(scores)) + "|")
        for row in rows:
            made = ["published", "–"]
            if not row["published"]:
                made = [row["training"][:6], _number(row["minutes"], 1)]
            values = [_number(row["scores"].get(score), _PLACES.get(score, 4)) for score in scores]
            cells = [row["data"], row["method"], "+".join(row["without"]) or "–", *made, *values]
            parts.append("| " + " | ".join(cells) + " |")
        parts.append("")
    return "\n".join(parts)


def _published(row: PublishedRow) -> dict[str, Any]:
    return {
        "published": True,
        "data": row.data,
        "method": METHODS[row.method],
        "without": list(row.without),
        "minutes": None,
        "scores": dict(row.scores),
    }


def _own(row: OwnRow, splits: tuple[str, ...], names: tuple[str, ...]) -> dict[str, Any]:
    """A row of one's own; scores of the first of the splits that it has."""
    split = next((split for split in splits if split in row.scores), None)
    scores = row.scores[split] if split else {}
    return {
        "published": False,
        "data": row.subject,
        "method": row.method,
        "without": list(row.without),
        "budget": row.budget,
        "minutes": row.minutes,
        "steps": row.steps,
        "training": row.key,
        "split": split,
        "scores": {name: scores.get(name) for name in names},
    }


def _number(value: float | None, places: int) -> str:
    return "–" if value is None else f"{value:.{places}f}"

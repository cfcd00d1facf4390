"""The paper's three tables (novel pose, novel view, ablation): published rows, then rows of own trainings.

Published values are those of Gaussian Wardrobe on 4D-DRESS and ActorsHQ, by the authors' code on their GPUs.
Own rows can be compared with them only on those data sets.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

METHODS = {"animatable-gaussians": "AG", "layga": "LayGA", "gaussian-wardrobe": "GW"}


@dataclass(frozen=True)
class PublishedRow:
    """One row: the data, the method as this project calls it, what was left out, and scores by name."""

    data: str
    method: str
    scores: dict[str, float]
    without: tuple[str, ...] = ()


def _pictures(data: str, **values: tuple[float, float, float]) -> list[PublishedRow]:
    """PSNR, SSIM and LPIPS of the three methods."""
    short = {name: method for method, name in METHODS.items()}
    scores = ("psnr", "ssim", "lpips")
    return [PublishedRow(data, short[n], dict(zip(scores, v, strict=True))) for n, v in values.items()]


def _labels(without: tuple[str, ...], miou: float, recall: float, f1: float) -> PublishedRow:
    return PublishedRow("4D-DRESS", "gaussian-wardrobe", {"miou": miou, "recall": recall, "f1": f1}, without)


NOVEL_POSE = [
    *_pictures(
        "4D-DRESS", AG=(27.75, 0.9577, 0.0531), LayGA=(27.58, 0.9574, 0.0543), GW=(28.06, 0.9579, 0.0527)
    ),
    *_pictures(
        "ActorsHQ", AG=(27.92, 0.9411, 0.0418), LayGA=(27.80, 0.9413, 0.0421), GW=(28.38, 0.9436, 0.0397)
    ),
]
NOVEL_VIEW = _pictures(
    "ActorsHQ", AG=(30.51, 0.9491, 0.0332), LayGA=(30.36, 0.9482, 0.0337), GW=(30.86, 0.9489, 0.0331)
)
ABLATION = [
    _labels(("sg",), 0.848, 0.898, 0.924),
    _labels(("reg",), 0.879, 0.922, 0.940),
    _labels(("pe",), 0.883, 0.927, 0.942),
    _labels((), 0.893, 0.936, 0.947),
]

_FOREGROUND = ("psnr_foreground", "ssim_foreground")
_PICTURES = ("psnr", "ssim", "lpips", "ms_ssim", *_FOREGROUND, "flip", "iou", "sharpness")
_LABELS = ("miou", "recall", "f1")
_TITLES = {"novel_pose": "Novel pose", "novel_view": "Novel view", "ablation": "Ablation: label pictures"}
_PLACES = {"psnr": 2, "psnr_foreground": 2, "sharpness": 2}


@dataclass(frozen=True)
class OwnRow:
    """A training of a subject and its means by split ("novel_pose", "novel_view"; a split may be missing).

    Attributes:
        subject, key, method, without: which training.
        minutes: duration. steps: optimiser steps.
        scores: split to score name to value or None. The first frame is left out where there are others.
        budget: minutes that the training was given; 0 where steps ended it, None where it is not known.
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
    """Rows of the tables "novel_pose", "novel_view" and "ablation", published rows first.

    Rows of one subject and budget stand together. Ablations are scored on novel poses where the capture has
    some, else on novel views. The whole method joins them where it had the same budget.
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
                _own(row, ("novel_pose", "novel_view"), (*_LABELS, *_FOREGROUND, "ms_ssim", "flip"))
                for row in sorted(own, key=_ablation_order)
            ),
        ],
    }


def _ablation_order(row: OwnRow) -> tuple[str, float, bool, tuple[str, ...]]:
    return row.subject, row.budget or 0.0, not row.without, row.without


def markdown(content: dict[str, list[dict[str, Any]]]) -> str:
    """The tables as text; "–" where a score is not known."""
    parts = [
        "Published rows (Gaussian Wardrobe) are of 4D-DRESS and ActorsHQ, trained for days on a GPU. The "
        "rows below them are of other data and say how long they were trained. psnr, ssim and ms_ssim cover "
        "the whole picture, white outside the mask; psnr_foreground, ssim_foreground and flip cover the "
        "subject alone.\n"
    ]
    for name, rows in content.items():
        scores = [score for score in (*_PICTURES, *_LABELS) if any(score in row["scores"] for row in rows)]
        if name == "ablation":
            scores = [*_LABELS, *(score for score in scores if score not in _LABELS)]
        parts.append(f"### {_TITLES[name]}\n")
        parts.append("| data | method | without | training | minutes | " + " | ".join(scores) + " |")
        parts.append("| --- " * (5 + len(scores)) + "|")
        for row in rows:
            effort = ["published", "–"]
            if not row["published"]:
                effort = [row["training"][:6], _number(row["minutes"], 1)]
            values = [_number(row["scores"].get(score), _PLACES.get(score, 4)) for score in scores]
            cells = [row["data"], row["method"], "+".join(row["without"]) or "–", *effort, *values]
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
    """A row of an own training, with the scores of the first of the splits that it has."""
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

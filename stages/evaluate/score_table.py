"""Scores per view, their means, and pictures of the errors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.sharding import Row, WorkItem, replace_picture
from stages.shared.artifacts.pictures import encode_png
from stages.shared.capture.labels import label_picture
from stages.shared.capture.take import MASK_THRESHOLD, box_around
from stages.shared.layers import BODY_LABELS, SKIN
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import Scores, ViewPair, mean_scores, view_scores
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk

_LARGEST_SIDE, _MARGIN = 384, 12  # px: of a picture as shown, and around the subject


class ScoredView(NamedTuple):
    """A view to score and the fields of its row. Scores named in `unknown` become None."""

    method: str
    take: str
    camera: str
    frame: int
    first: bool
    view: ViewPair
    unknown: Sequence[str] = ()


@dataclass
class ScoreTable:
    """Rows of one split: method, take, camera, frame and scores. LPIPS only with `perceptual`."""

    perceptual: Perceptual | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self,
        method: str,
        take: str,
        camera: str,
        frame: int,
        first: bool,
        view: ViewPair,
        unknown: Sequence[str] = (),
    ) -> Scores:
        """Score a view and add its row. Scores named in `unknown` have no meaning and become None."""
        scores = view_scores(view, self.perceptual) | dict.fromkeys(unknown)
        finite = {k: None if v is None or not np.isfinite(v) else round(v, 6) for k, v in scores.items()}
        self.rows.append(
            {"method": method, "take": take, "camera": camera, "frame": frame, "first": first, **finite}
        )
        return scores

    def means(self) -> dict[str, Any]:
        """Means per method, and again without the first frame of each take."""
        means: dict[str, Any] = {}
        for method in dict.fromkeys(row["method"] for row in self.rows):
            rows = [row for row in self.rows if row["method"] == method]
            means[method] = {"views": len(rows), **mean_scores(rows)}
            later = [row for row in rows if not row["first"]]
            if later and len(later) < len(rows):
                means[f"{method}_without_first"] = {"views": len(later), **mean_scores(later)}
        return means


def comparison(
    truth: NDArray[np.uint8], labels: NDArray[np.uint8] | None, views: dict[str, ViewPair]
) -> NDArray[np.uint8]:
    """(H, W, 3) u8: truth | each method | its error, and a row of labels when there are any."""
    top, captions = [truth], ["truth"]
    bottom = [label_picture(labels)] if labels is not None else []
    for method, view in views.items():
        error = np.abs(view.prediction.astype(np.int16) - truth.astype(np.int16)).astype(np.uint8)
        top += [view.prediction, error]
        captions += [method, f"error of {method}"]
        if labels is not None and view.prediction_labels is not None:
            wrong = np.where(
                _with_one_body(view.prediction_labels) != _with_one_body(labels), np.uint8(255), np.uint8(0)
            )
            bottom += [label_picture(view.prediction_labels), np.repeat(wrong[..., None], 3, axis=2)]
    cut = subject_crop(next(iter(views.values())).mask)
    pictures = [shrunk(np.ascontiguousarray(picture[cut]), _LARGEST_SIDE) for picture in top + bottom]
    captions += ["labels" if index == 0 or index % 2 else "wrong labels" for index in range(len(bottom))]
    return contact_sheet(pictures, len(top), captions)


def _with_one_body(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Label ids with hair and shoes counted as skin: the body is one layer."""
    return np.where(np.isin(labels, BODY_LABELS), np.uint8(SKIN), labels)


def subject_crop(mask: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Rows and columns around the mask (H, W) of a picture, with a margin; all of them where it is empty."""
    box = box_around(mask > MASK_THRESHOLD, _MARGIN)
    if box is None:
        return slice(None), slice(None)
    left, top, right, bottom = box
    return slice(top, bottom), slice(left, right)


def pair_items(
    split: str,
    count: int,
    read: Callable[[int], ScoredView],
    perceptual: Perceptual | None,
    pictures: int,
) -> list[WorkItem]:
    """A item of work for each of `count` pairs; `pictures` of them leave `<split>_<n>.png`."""
    shown = chosen(count, pictures)

    def score(index: int, folder: Path) -> list[Row]:
        scored = read(index)
        table = ScoreTable(perceptual)
        table.add(*scored)
        if index in shown:
            view = scored.view
            picture = encode_png(comparison(view.truth, view.truth_labels, {scored.method: view}))
            replace_picture(folder / f"{split}_{shown.index(index)}.png", picture)
        return table.rows

    return [WorkItem(split, functools.partial(score, index)) for index in range(count)]

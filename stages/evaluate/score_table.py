"""Scores per view, their means, and pictures of the errors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.methods import Method
from stages.evaluate.sharding import Row, WorkItem, replace_picture
from stages.evaluate.views import FrameViews
from stages.shared.artifacts.pictures import encode_png
from stages.shared.capture.labels import label_picture
from stages.shared.capture.take import MASK_THRESHOLD, box_around
from stages.shared.layers import BODY_LABELS, SKIN
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import Scores, ViewPair, mean_scores, view_scores
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.report import Report

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


def score_frame(
    frame: FrameViews, methods: Mapping[str, Method], perceptual: Perceptual | None = None
) -> Iterator[tuple[dict[str, ViewPair], list[Row]]]:
    """Render a frame by every method and score it: pictures and rows of one view after the other."""
    for method in methods.values():
        method.pose(frame)
    for camera in frame.cameras:
        truth = frame.take.image(camera, frame.frame), frame.take.mask(camera, frame.frame)
        labels = frame.take.labels(camera, frame.frame)
        pairs, table = {}, ScoreTable(perceptual)
        for kind, method in methods.items():
            picture, alpha, ids = method.render(frame.take.camera(camera))
            pairs[kind] = ViewPair(picture, alpha, *truth, ids, labels)
            table.add(kind, frame.take.name, camera, frame.frame, frame.first, pairs[kind])
        yield pairs, table.rows


def score_views(views: Sequence[FrameViews], methods: Mapping[str, Method], report: Report) -> ScoreTable:
    """The scores of every view by every method."""
    table = ScoreTable()
    for index, frame in enumerate(views):
        for _, rows in score_frame(frame, methods):
            table.rows += rows
        report.progress(index + 1, len(views))
    return table


def view_items(
    split: str,
    views: Sequence[FrameViews],
    methods: Mapping[str, Method],
    perceptual: Perceptual | None,
    pictures: int,
) -> list[WorkItem]:
    """The frames of a split as items of work; `pictures` of them leave `<split>_<n>.png`."""
    shown = chosen(len(views), pictures)

    def score(index: int, folder: Path) -> list[Row]:
        rows: list[Row] = []
        for order, (pairs, scored) in enumerate(score_frame(views[index], methods, perceptual)):
            rows += scored
            if index in shown and order == index % len(views[index].cameras):
                view = next(iter(pairs.values()))
                picture = encode_png(comparison(view.truth, view.truth_labels, pairs))
                replace_picture(folder / f"{split}_{shown.index(index)}.png", picture)
        return rows

    return [WorkItem(split, functools.partial(score, index)) for index in range(len(views))]

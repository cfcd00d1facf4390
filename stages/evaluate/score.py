"""Render and score views, and save comparison pictures of some of them."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from stages.evaluate.methods import Method
from stages.evaluate.score_table import ScoreTable, comparison
from stages.evaluate.sharding import Row, WorkItem, replace_picture
from stages.evaluate.views import FrameViews
from stages.shared.artifacts.pictures import encode_png
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import ViewPair
from stages.shared.pictures.sheet import chosen
from stages.shared.report import Report


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

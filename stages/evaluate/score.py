"""Render and score views, and keep a few side by side with the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.gather import Gathered, comparison
from stages.evaluate.methods import Method
from stages.evaluate.views import FrameViews
from stages.shared.artifacts.files import write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import ViewPair
from stages.shared.pictures.sheet import chosen
from stages.shared.report import Report


@dataclass(frozen=True)
class Album:
    """Where pictures go: `<name>_<n>.png` in `folder`, `pictures` of them spread over the frames."""

    folder: Path
    name: str
    pictures: int

    def keep(
        self,
        index: int,
        count: int,
        order: int,
        cameras: int,
        truth: NDArray[np.uint8],
        labels: NDArray[np.uint8] | None,
        pairs: dict[str, ViewPair],
    ) -> None:
        """Write a view if it is one of those: of frame `index` of `count`, by camera `order` of `cameras`."""
        shown = chosen(count, self.pictures)
        if index in shown and order == index % cameras:
            picture = encode_png(comparison(truth, labels, pairs))
            write_file(self.folder / f"{self.name}_{shown.index(index)}.png", picture)


def score_views(
    views: Sequence[FrameViews],
    methods: Mapping[str, Method],
    report: Report,
    perceptual: Perceptual | None = None,
    album: Album | None = None,
) -> Gathered:
    """Render every view by every method, and score it."""
    gathered = Gathered(perceptual)
    done, total = 0, sum(len(frame.cameras) for frame in views)
    for index, frame in enumerate(views):
        for method in methods.values():
            method.pose(frame)
        for order, camera in enumerate(frame.cameras):
            truth = frame.take.image(camera, frame.frame), frame.take.mask(camera, frame.frame)
            labels = frame.take.labels(camera, frame.frame)
            pairs = {}
            for kind, method in methods.items():
                picture, alpha, ids = method.render(frame.take.camera(camera))
                pairs[kind] = ViewPair(picture, alpha, *truth, ids, labels)
                gathered.add(kind, frame.take.name, camera, frame.frame, frame.first, pairs[kind])
            if album is not None:
                album.keep(index, len(views), order, len(frame.cameras), truth[0], labels, pairs)
            done += 1
            report.progress(done, total)
    return gathered

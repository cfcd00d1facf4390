"""Scores view by view, their means, and the pictures that show what the numbers mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.labels import label_picture
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import Scores, ViewPair, mean_scores, view_scores
from stages.shared.pictures.sheet import contact_sheet, shrunk

_LARGEST_SIDE = 384


@dataclass
class Gathered:
    """Rows of one split: who, where, which method, and the scores; LPIPS only with `perceptual`."""

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
        """Score a view and keep the row; the scores called `unknown` mean nothing here and are None."""
        scores = view_scores(view, self.perceptual) | dict.fromkeys(unknown)
        finite = {k: None if v is None or not np.isfinite(v) else round(v, 6) for k, v in scores.items()}
        self.rows.append(
            {"method": method, "take": take, "camera": camera, "frame": frame, "first": first, **finite}
        )
        return scores

    def means(self) -> dict[str, Any]:
        """Means per method, and again without the first frame of each take."""
        found: dict[str, Any] = {}
        for method in dict.fromkeys(row["method"] for row in self.rows):
            own = [row for row in self.rows if row["method"] == method]
            found[method] = {"views": len(own), **mean_scores(own)}
            later = [row for row in own if not row["first"]]
            if later and len(later) < len(own):
                found[f"{method}_without_first"] = {"views": len(later), **mean_scores(later)}
        return found


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
            wrong = np.where(_merged(view.prediction_labels) != _merged(labels), np.uint8(255), np.uint8(0))
            bottom += [label_picture(view.prediction_labels), np.repeat(wrong[..., None], 3, axis=2)]
    cut = _box(next(iter(views.values())).mask)
    pictures = [shrunk(np.ascontiguousarray(picture[cut]), _LARGEST_SIDE) for picture in top + bottom]
    captions += ["labels" if index == 0 or index % 2 else "wrong labels" for index in range(len(bottom))]
    return contact_sheet(pictures, len(top), captions)


def _merged(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Label ids with hair and shoes counted as skin: the body is one layer."""
    return np.where(labels <= 2, np.uint8(0), labels)


def _box(mask: NDArray[np.uint8], margin: int = 12) -> tuple[slice, slice]:
    """The part of the image around the mask."""
    rows, columns = np.flatnonzero((mask > 127).any(axis=1)), np.flatnonzero((mask > 127).any(axis=0))
    if not len(rows):
        return slice(None), slice(None)
    return (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )

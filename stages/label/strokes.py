"""Corrections of a labelling: strokes in pictures or on the surface, read from JSON and put on vertices."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.label.config import Stroke
from stages.shared.capture.projection import visibility
from stages.shared.capture.take import Take
from stages.shared.errors import BadData
from stages.shared.input_files import read_json_object
from stages.shared.layers import LABELS, NO_LABEL, label_id
from stages.shared.meshes.raycast import RayScene

FORMAT = "gw-strokes"
_MOST_STROKES, _MOST_POINTS = 10_000, 100_000
_NEAREST = 3.0  # of the radius: how far a thin stroke reaches for the vertex nearest to it
Doubles = NDArray[np.float64]


def read_strokes(path: Path) -> tuple[Stroke, ...]:
    """The strokes of a JSON file: `{"format": "gw-strokes", "version": 1, "strokes": [...]}`.

    Each stroke has a `label` (name), `points` and a `radius`. With a `view` (camera name), points are pixels
    (x, y) and the radius too; without one they are (x, y, z) in metres in the world.

    Raises:
        MissingInput: there is no such file. BadData: it is something else, or a stroke is damaged.
    """
    value = read_json_object(path, "a stroke file")
    strokes = value.get("strokes")
    if value.get("format") != FORMAT or value.get("version") != 1 or not isinstance(strokes, list):
        raise BadData(
            "This is no stroke file of version 1.",
            str(path),
            f'Write {{"format": "{FORMAT}", "version": 1, "strokes": [...]}} (docs/formats.md).',
        )
    if len(strokes) > _MOST_STROKES:
        raise BadData(f"There are {len(strokes)} strokes.", str(path), f"Write at most {_MOST_STROKES}.")
    return tuple(_stroke(stroke, f"{path}: strokes[{index}]") for index, stroke in enumerate(strokes))


def _stroke(value: Any, where: str) -> Stroke:
    if not isinstance(value, dict):
        raise BadData("A stroke is no object.", where, "Give it label, points, radius and view.")
    names = [name for label, name in LABELS.items() if label != NO_LABEL]
    if value.get("label") not in names:
        raise BadData(
            f"There is no label {value.get('label')!r}.", f"{where}: label", "Use one of: " + ", ".join(names)
        )
    view = value.get("view")
    size = 3 if view is None else 2
    try:
        points = np.array(value.get("points"), np.float64)
        radius = float(value.get("radius"))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        points, radius = np.zeros(0), 0.0
    right = points.ndim == 2 and 0 < len(points) <= _MOST_POINTS and points.shape[-1] == size
    if not (right and np.isfinite(points).all() and 0 < radius < 1e6 and isinstance(view, str | None)):
        raise BadData(
            f"The points are no list of {size} numbers each, or the radius is not positive.",
            where,
            "With a view, points are pixels (x, y); without one they are (x, y, z) in metres.",
        )
    return Stroke(label_id(value["label"]), tuple(map(tuple, points.tolist())), radius, view)


def stroke_labels(
    strokes: Sequence[Stroke], vertices: Doubles, normals: Doubles, scene: RayScene, take: Take
) -> NDArray[np.uint8]:
    """(V,) u8 label of the vertices (V, 3) m world that strokes cover, else `NO_LABEL`; later strokes win.

    Raises:
        UsageProblem: a stroke names a camera that is not there. BadData: a stroke does not touch the person.
    """
    labels = np.full(len(vertices), NO_LABEL, np.uint8)
    for index, stroke in enumerate(strokes):
        line = np.array(stroke.points)
        if stroke.view is None:
            places, reachable = vertices, np.ones(len(vertices), bool)
        else:
            sight = visibility(vertices, normals, take.camera(stroke.view), scene)
            places, reachable = sight.pixels, sight.visible
        away = np.full(len(vertices), np.inf)
        away[reachable] = _distance_to_line(places[reachable], line)
        covered = away <= stroke.radius
        if not covered.any() and away.min() <= _NEAREST * stroke.radius:
            covered = away == away.min()
        if not covered.any():
            raise BadData(
                "The stroke does not touch the person.",
                f"strokes[{index}], view {stroke.view}",
                "Draw it on the person, or check the name of the camera.",
            )
        labels[covered] = stroke.label
    return labels


def _distance_to_line(points: Doubles, line: Doubles) -> Doubles:
    """(N,) distance of points (N, D) to a polyline (K, D); one point is a line too."""
    starts, ends = line[:-1], line[1:]
    if len(line) == 1:
        starts, ends = line, line
    distance = np.full(len(points), np.inf)
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        distance = np.minimum(distance, np.linalg.norm(points - start - share[:, None] * along, axis=1))
    return distance

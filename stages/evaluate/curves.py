"""Learning curves: scores of methods against minutes of training, as JSON lines, a figure and pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.config import EvaluateConfig
from stages.evaluate.figure import Curve, Panel, figure
from stages.evaluate.methods import Method, TrainedMethod
from stages.evaluate.score import score_views
from stages.evaluate.views import FrameViews, require_views, views_of
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.files import write_whole
from stages.shared.body import BodyModel
from stages.shared.capture.subject import open_subject_capture
from stages.shared.outfit.outfit import Outfit, outfit_of_training
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.report import SILENT

_LARGEST_SIDE = 320
_SHOWN = {"psnr_foreground": "PSNR of the foreground, dB", "ssim_foreground": "SSIM of the foreground"}
_MARGIN = 10  # px around the subject


@dataclass(frozen=True)
class CurveViews:
    """The views that every point of a curve is scored on, by split."""

    splits: dict[str, list[FrameViews]]

    @classmethod
    def of(cls, subject: Path, config: EvaluateConfig) -> CurveViews:
        """Views of a subject's capture. Raises MissingInput where a split has none."""
        workspace = Workspace(subject)
        registered = workspace.require(REGISTER_TEMPLATE)
        body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
        capture = open_subject_capture(workspace, body)
        splits = {}
        for split in config.splits:
            views = views_of(split, capture, str(registered.summary["take"]), config)
            require_views(views, split, capture)
            splits[split.replace("-", "_")] = views
        return cls(splits)

    def scores(self, outfit: Outfit) -> dict[str, dict[str, float | None]]:
        """Split to means, without the first frame of a take where there are others."""
        found = {}
        for split, views in self.splits.items():
            means = score_views(views, {"trained": TrainedMethod(outfit)}, SILENT).means()
            found[split] = means.get("trained_without_first", means["trained"])
        return found


@dataclass
class CurveFile:
    """Points of curves, one JSON object a line; a point measured again replaces the older one.

    Attributes:
        path: of the file. views: what tells the scored views; points of other views are dropped, since they
            cannot be compared. points: {"name", "minutes", "steps", "views", split: means}.
    """

    path: Path
    views: str
    points: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.path.is_file():
            known = [json.loads(line) for line in self.path.read_text().splitlines()]
            self.points = [point for point in known if point["views"] == self.views]

    @property
    def names(self) -> list[str]:
        """Names of all curves."""
        return list(dict.fromkeys(point["name"] for point in self.points))

    def add(self, point: dict[str, Any]) -> None:
        """Keep a point, and write the file whole."""
        point = {**point, "views": self.views}
        same = {key: point[key] for key in ("name", "minutes")}
        kept = [old for old in self.points if {key: old[key] for key in same} != same]
        self.points = sorted([*kept, point], key=lambda one: (one["name"], one["minutes"]))
        write_whole(self.path, "".join(json.dumps(one) + "\n" for one in self.points).encode())

    def of(self, name: str) -> list[dict[str, Any]]:
        """Points of one curve, by minutes."""
        return [point for point in self.points if point["name"] == name]


def curve_figure(points: CurveFile, splits: Sequence[str]) -> NDArray[np.uint8]:
    """PSNR and SSIM of the foreground against minutes, a column per split: (H, W, 3) u8."""
    rows = []
    for score, title in _SHOWN.items():
        panels = []
        for split in splits:
            curves = []
            for name in points.names:
                known = [(p["minutes"], p[split][score]) for p in points.of(name) if split in p]
                curves.append(Curve(name, [(x, y) for x, y in known if y is not None]))
            panels.append(Panel(f"{split.replace('_', ' ')}: {title}", "minutes of training", curves))
        rows.append(panels)
    return figure(rows)


def outfit_of(subject: Path, training: Artifact) -> Outfit:
    """The outfit that a finished training gives."""
    workspace = Workspace(subject)
    return outfit_of_training(workspace.require(REGISTER_TEMPLATE), workspace.require(BAKE_MAPS), training)


def side_by_side(views: CurveViews, outfits: Mapping[str, Outfit], pictures: int = 2) -> NDArray[np.uint8]:
    """Truth and every method in a row, `pictures` rows of every split: (H, W, 3) u8."""
    methods: dict[str, Method] = {name: TrainedMethod(outfit) for name, outfit in outfits.items()}
    cells, captions = [], []
    for split, frames in views.splits.items():
        for index in chosen(len(frames), pictures):
            frame = frames[index]
            camera = frame.cameras[index % len(frame.cameras)]
            cut = _box(frame.take.mask(camera, frame.frame))
            cells.append(frame.take.image(camera, frame.frame)[cut])
            captions.append(f"truth, {split.replace('_', ' ')}, frame {frame.frame}")
            for name, method in methods.items():
                method.pose(frame)
                cells.append(method.render(frame.take.camera(camera))[0][cut])
                captions.append(name)
    small = [shrunk(np.ascontiguousarray(cell), _LARGEST_SIDE) for cell in cells]
    return contact_sheet(small, 1 + len(methods), captions)


def _box(mask: NDArray[np.uint8]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero((mask > 127).any(axis=1)), np.flatnonzero((mask > 127).any(axis=0))
    if not len(rows):
        return slice(None), slice(None)
    top, left = max(0, rows[0] - _MARGIN), max(0, columns[0] - _MARGIN)
    return slice(top, rows[-1] + 1 + _MARGIN), slice(left, columns[-1] + 1 + _MARGIN)

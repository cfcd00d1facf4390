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
from stages.evaluate.methods import TrainedMethod
from stages.evaluate.score_table import score_views
from stages.evaluate.views import FrameViews, views_by_split
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.files import write_whole
from stages.shared.body import BodyModel
from stages.shared.capture.subject import open_subject_capture
from stages.shared.charts import Curve, Panel, draw_charts
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.report import SILENT

SHOWN = {"psnr_foreground": "PSNR of the foreground, dB", "ssim_foreground": "SSIM of the foreground"}
SHOWN_OF_ABLATIONS = {**SHOWN, "miou": "mean IoU of garment labels"}
_OWN, _LESS = "gaussian-wardrobe", "without "  # how names of curves begin


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
        return cls(views_by_split(capture, str(registered.summary["take"]), config))

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
        """Names of all curves, this project's first."""
        known = dict.fromkeys(point["name"] for point in self.points)
        return sorted(known, key=lambda name: not name.startswith(_OWN))

    @property
    def ablations(self) -> list[str]:
        """Names of the ablation curves, after those of the full method with the same budgets."""
        less = [name for name in self.names if name.startswith(_LESS)]
        return [name for name in self.names if name in {_OWN + budget_of(one) for one in less}] + less

    @property
    def methods(self) -> list[str]:
        """All other curves, without those of the full method that are only a comparison for ablations."""
        rest = [name for name in self.names if not name.startswith(_LESS)]
        others = {budget_of(name) for name in rest if not name.startswith(_OWN)}
        comparisons = {name for name in self.ablations if budget_of(name) not in others}
        return [name for name in rest if name not in comparisons] or rest

    def add(self, point: dict[str, Any]) -> None:
        """Add a point and write the file."""
        point = {**point, "views": self.views}
        same = {key: point[key] for key in ("name", "minutes")}
        kept = [old for old in self.points if {key: old[key] for key in same} != same]
        self.points = sorted([*kept, point], key=lambda one: (one["name"], one["minutes"]))
        write_whole(self.path, "".join(json.dumps(one) + "\n" for one in self.points).encode())

    def of(self, name: str) -> list[dict[str, Any]]:
        """Points of one curve, by minutes."""
        return [point for point in self.points if point["name"] == name]


def budget_of(name: str) -> str:
    """What a curve's name says of preset, minutes and seed, as " (draft, 20 min)"."""
    return name[name.index(" (") :] if " (" in name else ""


def curve_figure(
    points: CurveFile, splits: Sequence[str], names: Sequence[str], shown: Mapping[str, str] = SHOWN
) -> NDArray[np.uint8]:
    """Scores (`shown`: score to title) of these curves against minutes, a column per split: (H, W, 3) u8."""
    rows = []
    for score, title in shown.items():
        panels = []
        for split in splits:
            curves = []
            for name in names:
                known = [(p["minutes"], p[split][score]) for p in points.of(name) if split in p]
                curves.append(Curve(name, [(x, y) for x, y in known if y is not None]))
            panels.append(Panel(f"{split.replace('_', ' ')}: {title}", "minutes of training", curves))
        rows.append(panels)
    return draw_charts(rows)


def outfit_of(subject: Path, training: Artifact) -> Outfit:
    """The outfit that a finished training gives."""
    workspace = Workspace(subject)
    registered, baked = workspace.require(REGISTER_TEMPLATE), workspace.require(BAKE_MAPS)
    return TrainedSubject(registered, baked, training).outfit()

"""Evaluate: render what was learned as the capture saw it, and score it beside a baseline without learning.

Reads:
    register-template: `body.safetensors`, `smpl_params.npz`. segment-layers: `<layer>.safetensors`.
    bake-maps, train (or distill): `<layer>.safetensors`, `model.json` (for the method "trained").
    the capture: images, masks, labels and poses of the views.
Writes, into the output folder:
    evaluation.json: {"novel_pose": {"trained": {score: mean}, "trained_without_first": …, "baseline": …},
    "novel_view": …}; views.json: every view's scores; <split>_<n>.png: truth, renders, errors, labels.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.baseline import Baseline
from stages.evaluate.config import METHODS, SPLITS, EvaluateConfig
from stages.evaluate.gather import Gathered, comparison
from stages.evaluate.views import FrameViews, require_views, views_of
from stages.pipeline import BAKE_MAPS, DISTILL, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.files import write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import BodyModel
from stages.shared.capture.camera import Camera
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import UsageProblem
from stages.shared.losses.perceptual import Perceptual
from stages.shared.metrics.scores import ViewPair
from stages.shared.outfit.outfit import Outfit, outfit_of_training
from stages.shared.outfit.picture import take_picture
from stages.shared.pictures.folder import output_folder
from stages.shared.pictures.sheet import chosen
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

Rendered = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]  # picture on black, alpha, labels
MARK = "gw-evaluation"
RESULT_NAME = "evaluation.json"


class Method(Protocol):
    """Something that can show a frame to a camera."""

    def pose(self, views: FrameViews) -> None: ...

    def render(self, camera: Camera) -> Rendered: ...


@dataclass(frozen=True)
class EvaluateResult:
    """The folder, and the means."""

    path: Path
    summary: dict[str, Any]


class TrainedMethod:
    """The trained layers of the subject."""

    def __init__(self, outfit: Outfit) -> None:
        self.outfit = outfit

    def pose(self, views: FrameViews) -> None:
        self._composite = self.outfit.composite(views.take.poses, views.frame)

    def render(self, camera: Camera) -> Rendered:
        shot = take_picture(self._composite, camera)
        return shot.on((0.0, 0.0, 0.0)), shot.alpha, shot.labels


class BaselineMethod:
    """The meshes that learned nothing."""

    def __init__(self, baseline: Baseline, supersampling: int) -> None:
        self.baseline, self.supersampling = baseline, supersampling

    def pose(self, views: FrameViews) -> None:
        self._scene = self.baseline.posed(views.take.poses, views.frame)

    def render(self, camera: Camera) -> Rendered:
        return self.baseline.render(self._scene, camera, self.supersampling)


def run(
    subject: Path,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
) -> EvaluateResult:
    """Score a subject; the folder is `SUBJECT/evaluation` unless told otherwise. LPIPS needs its weights.

    Raises:
        MissingInput: a stage has not run, or a split has no views. UsageProblem: unknown split or method.
    """
    check_config(config)
    started = time.monotonic()
    workspace, output = Workspace(subject), output or subject / "evaluation"
    registered = workspace.require(REGISTER_TEMPLATE)
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    capture = open_subject_capture(workspace, body)
    splits = {s: views_of(s, capture, str(registered.summary["take"]), config) for s in config.splits}
    for split, views in splits.items():
        require_views(views, split, capture)
    methods = _methods(workspace, body, config)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    summary: dict[str, Any] = {}
    rows: dict[str, Any] = {}
    with output_folder(output, RESULT_NAME, MARK) as folder:
        for split, views in splits.items():
            name = split.replace("-", "_")
            gathered = _score(folder, name, views, methods, config, report, perceptual)
            summary[name], rows[name] = gathered.means(), gathered.rows
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_file(folder / "views.json", readable_json(rows))
        content = {"format": MARK, "version": 1, "config": asdict(config), **summary}
        if perceptual_weights:
            content["perceptual_digest"] = file_digest(perceptual_weights)
        write_file(folder / RESULT_NAME, readable_json(content))
    return EvaluateResult(output, summary)


def plan(subject: Path, output: Path | None = None, config: EvaluateConfig = EvaluateConfig()) -> Plan:
    """What `run` would read, write and cost."""
    check_config(config)
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    capture = open_subject_capture(workspace, BodyModel.from_arrays(registered.arrays("body.safetensors")))
    splits = {s: views_of(s, capture, str(registered.summary["take"]), config) for s in config.splits}
    count = sum(len(frame.cameras) for views in splits.values() for frame in views)
    return Plan(
        inputs=[str(workspace.root), str(capture.root)],
        outputs=[str((output or subject / "evaluation") / RESULT_NAME)],
        config=asdict(config),
        seconds=0.5 * count * len(config.methods),
        memory_bytes=900_000_000,
        disk_bytes=2_000_000,
    )


def check_config(config: EvaluateConfig) -> None:
    """Raise UsageProblem for splits and methods that do not exist, and for none at all."""
    for option, given, known in (("split", config.splits, SPLITS), ("methods", config.methods, METHODS)):
        unknown = [name for name in given if name not in known]
        if unknown or not given:
            raise UsageProblem(
                f"{unknown[0] if unknown else 'nothing'!r} cannot be evaluated.",
                f"option --{option}",
                "Choose of: " + ", ".join(known) + ".",
            )


def _methods(workspace: Workspace, body: BodyModel, config: EvaluateConfig) -> dict[str, Method]:
    registered = workspace.require(REGISTER_TEMPLATE)
    methods: dict[str, Method] = {}
    for name, spec in (("trained", TRAIN), ("distilled", DISTILL)):
        if name in config.methods:
            parts = (registered, workspace.require(BAKE_MAPS), workspace.require(spec))
            methods[name] = TrainedMethod(outfit_of_training(*parts))
    if "baseline" in config.methods:
        betas = load_poses(registered.file("smpl_params.npz"), body).betas
        baseline = Baseline.load(workspace.require(SEGMENT_LAYERS), body, betas)
        methods["baseline"] = BaselineMethod(baseline, config.supersampling)
    return methods


def _score(
    folder: Path,
    name: str,
    views: list[FrameViews],
    methods: dict[str, Method],
    config: EvaluateConfig,
    report: Report,
    perceptual: Perceptual | None,
) -> Gathered:
    """Render and score every view of a split, and write its pictures."""
    report.step(name.replace("_", " "))
    gathered = Gathered(perceptual)
    shown = chosen(len(views), config.pictures)
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
            if index in shown and order == index % len(frame.cameras):
                number = shown.index(index)
                write_file(folder / f"{name}_{number}.png", encode_png(comparison(truth[0], labels, pairs)))
            done += 1
            report.progress(done, total)
    return gathered

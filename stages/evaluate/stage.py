"""Evaluate: render what was learned as the capture saw it, and score it beside a baseline without learning.

Reads:
    register-template: `body.safetensors`, `smpl_params.npz`. segment-layers: `<layer>.safetensors`.
    bake-maps, train (or distill): `<layer>.safetensors`, `model.json` (for the method "trained").
    the capture: images, masks, labels and poses of the views.
Writes, into the output folder:
    evaluation.json: {"training": which, "novel_pose": {"trained": {score: mean}, "trained_without_first": …,
    "baseline": …}, "novel_view": …}; views.json: every view's scores; <split>_<n>.png: truth, renders,
    errors, labels. With true meshes, "vertex_error" (stages/evaluate/vertices) and vertices.json, by frame.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stages.evaluate.baseline import Baseline
from stages.evaluate.config import METHODS, SPLITS, EvaluateConfig
from stages.evaluate.methods import BaselineMethod, Method, TrainedMethod
from stages.evaluate.result import MARK, RESULT_NAME, EvaluateResult, write_evaluation
from stages.evaluate.score import Album, score_views
from stages.evaluate.vertices import posings_of, vertex_errors
from stages.evaluate.views import FrameViews, require_views, views_of
from stages.pipeline import BAKE_MAPS, DISTILL, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_file
from stages.shared.artifacts.spec import StageSpec
from stages.shared.body import BodyModel
from stages.shared.capture import Capture
from stages.shared.capture.subject import open_subject_capture
from stages.shared.capture.true_meshes import TrueMeshes, true_meshes_of
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.losses.perceptual import Perceptual
from stages.shared.outfit.outfit import outfit_of_training
from stages.shared.pictures.folder import output_folder
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report


def run(
    subject: Path,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
    true_meshes: Sequence[str] = (),
) -> EvaluateResult:
    """Score a subject; the folder is `SUBJECT/evaluation` unless told otherwise. LPIPS needs its weights.

    Arguments:
        true_meshes: as `true_meshes_of` takes them; garments are measured against them as well.

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
    meshes = _true_meshes(true_meshes, capture, config)
    methods, training = _methods(workspace, body, config)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    summary: dict[str, Any] = {"training": training} if training else {}
    rows: dict[str, Any] = {}
    with output_folder(output, RESULT_NAME, MARK) as folder:
        for split, views in splits.items():
            name = split.replace("-", "_")
            report.step(name.replace("_", " "))
            gathered = score_views(views, methods, report, perceptual, Album(folder, name, config.pictures))
            summary[name], rows[name] = gathered.means(), gathered.rows
        if meshes:
            summary["vertex_error"] = _measured(folder, splits, meshes, methods, capture, registered, report)
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_evaluation(folder, config, summary, rows, perceptual_weights)
    return EvaluateResult(output, summary)


def plan(
    subject: Path,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    true_meshes: Sequence[str] = (),
) -> Plan:
    """What `run` would read, write and cost."""
    check_config(config)
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    capture = open_subject_capture(workspace, BodyModel.from_arrays(registered.arrays("body.safetensors")))
    splits = {s: views_of(s, capture, str(registered.summary["take"]), config) for s in config.splits}
    count = sum(len(frame.cameras) for views in splits.values() for frame in views)
    names = [RESULT_NAME, *(["vertices.json"] if _true_meshes(true_meshes, capture, config) else [])]
    return Plan(
        inputs=[str(workspace.root), str(capture.root), *true_meshes],
        outputs=[str((output or subject / "evaluation") / name) for name in names],
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


def chosen_training(workspace: Workspace, spec: StageSpec, key: str) -> Artifact:
    """The training in use, or the one whose key begins with `key`.

    Raises:
        MissingInput: there is none. UsageProblem: it is of other maps than those in use.
    """
    if not key:
        return workspace.require(spec)
    found = [
        path for path in workspace.artifacts() if path.parent.name == spec.name and path.name.startswith(key)
    ]
    if len(found) != 1:
        raise MissingInput(
            f"{len(found)} trainings have a key that begins with {key!r}.",
            str(workspace.root / spec.name),
            "Give more of the key, or none for the training in use.",
        )
    artifact = Artifact(found[0])
    if artifact.manifest.inputs["bake-maps"].key != workspace.require(BAKE_MAPS).key:
        raise UsageProblem(
            "That training is of other maps than those in use.",
            str(artifact.path),
            "Train again, or leave it.",
        )
    return artifact


def _methods(
    workspace: Workspace, body: BodyModel, config: EvaluateConfig
) -> tuple[dict[str, Method], dict[str, Any]]:
    """What is scored, and which training that is."""
    registered = workspace.require(REGISTER_TEMPLATE)
    methods: dict[str, Method] = {}
    training: dict[str, Any] = {}
    for name, spec in (("trained", TRAIN), ("distilled", DISTILL)):
        if name in config.methods:
            trained = chosen_training(workspace, spec, config.training if name == "trained" else "")
            methods[name] = TrainedMethod(
                outfit_of_training(registered, workspace.require(BAKE_MAPS), trained)
            )
            known = {word: trained.summary.get(word) for word in ("method", "without", "steps", "gaussians")}
            training[name] = {"key": trained.key, **known}
    if "baseline" in config.methods:
        betas = load_poses(registered.file("smpl_params.npz"), body).betas
        baseline = Baseline.load(workspace.require(SEGMENT_LAYERS), body, betas)
        methods["baseline"] = BaselineMethod(baseline, config.supersampling)
    return methods, training


def _true_meshes(given: Sequence[str], capture: Capture, config: EvaluateConfig) -> dict[str, TrueMeshes]:
    """Take to true meshes; refused where nothing that was learned is scored."""
    if given and not {"trained", "distilled"} & set(config.methods):
        raise UsageProblem(
            "True meshes are compared with what was trained, and that is not scored.",
            "options --true-meshes and --methods",
            "Add trained to --methods.",
        )
    return true_meshes_of(list(given), capture)


def _measured(
    folder: Path,
    splits: dict[str, list[FrameViews]],
    meshes: dict[str, TrueMeshes],
    methods: dict[str, Method],
    capture: Capture,
    registered: Artifact,
    report: Report,
) -> dict[str, Any]:
    """Measure against the true meshes what was learned, and its texels moved by the bones alone."""
    outfits = {name: method.outfit for name, method in methods.items() if isinstance(method, TrainedMethod)}
    template = capture.take(str(registered.summary["take"])), int(registered.summary["frame"])
    named = {split.replace("-", "_"): views for split, views in splits.items()}
    found, rows = vertex_errors(named, meshes, posings_of(outfits), template, report)
    write_file(folder / "vertices.json", readable_json(rows))
    return found

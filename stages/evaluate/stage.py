"""Evaluate: render the trained layers from the cameras of the capture, and score them and a baseline.

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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.evaluate.baseline import Baseline
from stages.evaluate.config import METHODS, SPLITS, EvaluateConfig
from stages.evaluate.methods import BaselineMethod, Method, TrainedMethod
from stages.evaluate.result import MARK, RESULT_NAME, EvaluateResult, write_evaluation
from stages.evaluate.score import view_items
from stages.evaluate.score_table import ScoreTable
from stages.evaluate.sharding import collect_rows, evaluation_key, score_items, shard_summary
from stages.evaluate.vertices import PosedLayers, Posing, posings_of, vertex_errors
from stages.evaluate.views import FrameViews, views_by_split
from stages.pipeline import BAKE_MAPS, DISTILL, FIT_CLOTH, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_whole
from stages.shared.artifacts.spec import StageSpec
from stages.shared.avatar.deform import PosedGaussians
from stages.shared.body import BodyModel, Poses
from stages.shared.capture import Capture, Take
from stages.shared.capture.subject import open_subject_capture
from stages.shared.capture.true_meshes import TrueMeshes, true_meshes_of
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.losses.perceptual import Perceptual
from stages.shared.outfit.cloth_fit import fitted_cloth
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

_LEARNED = {"trained": TRAIN, "distilled": DISTILL}  # method to the stage that makes it


def run(
    subject: Path,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    report: Report = SILENT,
    perceptual_weights: Path | None = None,
    true_meshes: Sequence[str] = (),
) -> EvaluateResult:
    """Score a subject; the default folder is `SUBJECT/evaluation`. LPIPS needs its weights.

    Arguments:
        true_meshes: as `true_meshes_of` takes them; garments are measured against them as well.

    Raises:
        MissingInput: a stage has not run, or a split has no views. UsageProblem: unknown split or method.
    """
    check_config(config)
    started, share, output = time.monotonic(), parse_share(config.shard), output or subject / "evaluation"
    check_output(output, RESULT_NAME, MARK)
    opened = _open(subject, config, true_meshes)
    methods, training = _methods(opened, config)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    items = [
        item
        for split, views in opened.splits.items()
        for item in view_items(split, views, methods, perceptual, config.pictures)
    ]
    report.step("scoring")
    with part_folder(output, _key(opened, config, perceptual_weights), share) as folder:
        already_scored = score_items(folder, items, share, report)
        if not share.whole:
            return EvaluateResult(output, shard_summary(items, config.shard, already_scored), False)
        rows = collect_rows(folder, items)
        summary: dict[str, Any] = {"training": training} if training else {}
        summary |= {split: ScoreTable(rows=rows[split]).means() for split in opened.splits}
        if opened.meshes:
            summary["vertex_error"] = _measured(folder, opened, methods, report)
        summary["seconds"] = round(time.monotonic() - started, 1)
        write_evaluation(folder, config, summary, rows, perceptual_weights)
        finish(folder, output, [])
    return EvaluateResult(output, summary)


def plan(
    subject: Path,
    output: Path | None = None,
    config: EvaluateConfig = EvaluateConfig(),
    true_meshes: Sequence[str] = (),
    perceptual_weights: Path | None = None,
) -> Plan:
    """What `run` would read, write and cost."""
    check_config(config)
    share, output = parse_share(config.shard), output or subject / "evaluation"
    check_output(output, RESULT_NAME, MARK)
    opened = _open(subject, config, true_meshes)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    frames = share.of([frame for views in opened.splits.values() for frame in views])
    names = (RESULT_NAME, "vertices.json") if opened.meshes else (RESULT_NAME,)
    return Plan(
        inputs=[str(opened.workspace.root), str(opened.capture.root), *true_meshes],
        outputs=[str(output / name) for name in names],
        config=asdict(config),
        seconds=0.5 * sum(len(frame.cameras) for frame in frames) * len(config.methods),
        memory_bytes=900_000_000,
        disk_bytes=2_000_000,
    )


@dataclass(frozen=True, eq=False)
class _Opened:
    """What is evaluated: artifacts by stage, views by split ("novel_pose"), true meshes by take."""

    workspace: Workspace
    artifacts: dict[str, Artifact]
    body: BodyModel
    capture: Capture
    splits: dict[str, list[FrameViews]]
    meshes: dict[str, TrueMeshes]

    @property
    def registered(self) -> Artifact:
        return self.artifacts[REGISTER_TEMPLATE.name]


def _open(subject: Path, config: EvaluateConfig, true_meshes: Sequence[str]) -> _Opened:
    workspace = Workspace(subject)
    registered = workspace.require(REGISTER_TEMPLATE)
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    capture = open_subject_capture(workspace, body)
    splits = views_by_split(capture, str(registered.summary["take"]), config)
    meshes = _true_meshes(true_meshes, capture, config)
    return _Opened(workspace, _artifacts(workspace, registered, config), body, capture, splits, meshes)


def _artifacts(workspace: Workspace, registered: Artifact, config: EvaluateConfig) -> dict[str, Artifact]:
    """What the methods are made from, by stage."""
    found = {REGISTER_TEMPLATE.name: registered}
    for name, spec in _LEARNED.items():
        if name in config.methods:
            found[BAKE_MAPS.name] = workspace.require(BAKE_MAPS)
            found[spec.name] = chosen_training(workspace, spec, config.training if name == "trained" else "")
            cloth = fitted_cloth(workspace)
            if cloth is not None and not config.training:
                found[FIT_CLOTH.name] = cloth
    if "baseline" in config.methods:
        found[SEGMENT_LAYERS.name] = workspace.require(SEGMENT_LAYERS)
    return found


def _key(opened: _Opened, config: EvaluateConfig, weights: Path | None) -> str:
    """Names what the scores follow from."""
    files = [path for group in ("cameras", "poses") for path in opened.capture.files(group)]
    seen: list[Any] = []
    for split, views in opened.splits.items():
        for frame in views:
            seen.append([split, frame.take.name, frame.frame, frame.cameras, frame.first])
            for camera in frame.cameras:
                view = frame.take.view(camera, frame.frame)
                files += [path for path in (view.image, view.mask, view.labels) if path is not None]
    digests = {stage: artifact.digest for stage, artifact in opened.artifacts.items()}
    return evaluation_key(config, {"artifacts": digests, "views": seen}, files, weights)


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


def _methods(opened: _Opened, config: EvaluateConfig) -> tuple[dict[str, Method], dict[str, Any]]:
    """What is scored, and which training that is."""
    artifacts = opened.artifacts
    methods: dict[str, Method] = {}
    training: dict[str, Any] = {}
    for name, spec in _LEARNED.items():
        if name in config.methods:
            trained = artifacts[spec.name]
            parts = (opened.registered, artifacts[BAKE_MAPS.name], trained, artifacts.get(FIT_CLOTH.name))
            methods[name] = TrainedMethod(TrainedSubject(*parts).outfit(), config.drive)
            known = {word: trained.summary.get(word) for word in ("method", "without", "steps", "gaussians")}
            training[name] = {"key": trained.key, **known}
    if "baseline" in config.methods:
        betas = load_poses(opened.registered.file("smpl_params.npz"), opened.body).betas
        baseline = Baseline.load(artifacts[SEGMENT_LAYERS.name], opened.body, betas)
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


def _measured(folder: Path, opened: _Opened, methods: dict[str, Method], report: Report) -> dict[str, Any]:
    """Measure against the true meshes what was learned, and its texels moved by the bones alone."""
    trained = {name: method for name, method in methods.items() if isinstance(method, TrainedMethod)}
    takes = [*opened.capture.training_takes, *opened.capture.test_takes]
    summary = opened.registered.summary
    template = opened.capture.take(str(summary["take"])), int(summary["frame"])
    found, rows = vertex_errors(opened.splits, opened.meshes, _posings(trained, takes), template, report)
    write_whole(folder / "vertices.json", readable_json(rows))
    return found


def _posings(methods: dict[str, TrainedMethod], takes: list[Take]) -> dict[str, Posing]:
    """How every method poses garments in a take, and the bones alone."""

    def in_take(method: TrainedMethod) -> PosedLayers:
        def posed(poses: Poses, frame: int) -> dict[str, PosedGaussians]:
            take = next((take for take in takes if take.poses is poses), None)
            return method.outfit.posed(poses, frame) if take is None else method.posed(take, frame)

        return posed

    outfits = {name: method.outfit for name, method in methods.items()}
    return posings_of(outfits, {name: in_take(method) for name, method in methods.items()})

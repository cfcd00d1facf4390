"""Source of an evaluation: a trained subject, rendered for the cameras of its capture, and a baseline.

Reads:
    register-template: `body.safetensors`, `smpl_params.npz`. segment-layers: `<layer>.safetensors`.
    bake-maps, train (or distill): `<layer>.safetensors`, `model.json` (for the method "trained").
    the capture: images, masks, labels and poses of the views.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.evaluate.config import METHODS, SPLITS, EvaluateConfig
from stages.evaluate.methods import Baseline, BaselineMethod, Method, TrainedMethod
from stages.evaluate.score_table import ScoreTable, view_items
from stages.evaluate.sharding import RESULT_NAME, Row, WorkItem
from stages.evaluate.source import Source
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
from stages.shared.outfit.trained_subject import TrainedSubject, fitted_cloth
from stages.shared.pictures.parts import Share
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import Report

_LEARNED = {"trained": TRAIN, "distilled": DISTILL}  # method to the stage that makes it


@dataclass(frozen=True, eq=False)
class SubjectSource(Source):
    """Artifacts by stage, views by split ("novel_pose"), and true meshes by take."""

    workspace: Workspace
    config: EvaluateConfig
    artifacts: dict[str, Artifact]
    body: BodyModel
    capture: Capture
    splits: dict[str, list[FrameViews]]
    meshes: dict[str, TrueMeshes]
    mesh_files: tuple[str, ...]

    @classmethod
    def open(cls, subject: Path, config: EvaluateConfig, true_meshes: Sequence[str] = ()) -> SubjectSource:
        """What a workspace holds.

        Raises:
            MissingInput: a stage has not run, or a split has no views. UsageProblem: unknown split or method.
        """
        check_config(config)
        workspace = Workspace(subject)
        registered = workspace.require(REGISTER_TEMPLATE)
        body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
        capture = open_subject_capture(workspace, body)
        splits = views_by_split(capture, str(registered.summary["take"]), config)
        meshes = _true_meshes(true_meshes, capture, config)
        artifacts = _artifacts(workspace, registered, config)
        return cls(workspace, config, artifacts, body, capture, splits, meshes, tuple(true_meshes))

    def identity(self) -> tuple[dict[str, Any], list[Path]]:
        files = [path for group in ("cameras", "poses") for path in self.capture.files(group)]
        views: list[Any] = []
        for split, frames in self.splits.items():
            for frame in frames:
                views.append([split, frame.take.name, frame.frame, frame.cameras, frame.first])
                for camera in frame.cameras:
                    view = frame.take.view(camera, frame.frame)
                    files += [path for path in (view.image, view.mask, view.labels) if path is not None]
        digests = {stage: artifact.digest for stage, artifact in self.artifacts.items()}
        return {"artifacts": digests, "views": views}, files

    def items(self, perceptual: Perceptual | None) -> list[WorkItem]:
        return [
            item
            for split, views in self.splits.items()
            for item in view_items(split, views, self.methods, perceptual, self.config.pictures)
        ]

    def summary(self, rows: dict[str, list[Row]], folder: Path, report: Report) -> dict[str, Any]:
        training = {name: self._description(name) for name in _LEARNED if name in self.config.methods}
        summary: dict[str, Any] = {"training": training} if training else {}
        summary |= {split: ScoreTable(rows=rows[split]).means() for split in self.splits}
        if self.meshes:
            summary["vertex_error"] = self._measure_vertices(folder, report)
        return summary

    def plan(self, output: Path, share: Share) -> Plan:
        frames = share.of([frame for views in self.splits.values() for frame in views])
        names = (RESULT_NAME, "vertices.json") if self.meshes else (RESULT_NAME,)
        return Plan(
            inputs=[str(self.workspace.root), str(self.capture.root), *self.mesh_files],
            outputs=[str(output / name) for name in names],
            config=asdict(self.config),
            seconds=0.5 * sum(len(frame.cameras) for frame in frames) * len(self.config.methods),
            memory_bytes=900_000_000,
            disk_bytes=2_000_000,
        )

    @functools.cached_property
    def methods(self) -> dict[str, Method]:
        """What is scored, by name."""
        registered = self.artifacts[REGISTER_TEMPLATE.name]
        methods: dict[str, Method] = {}
        for name, spec in _LEARNED.items():
            if name in self.config.methods:
                maps, trained = self.artifacts[BAKE_MAPS.name], self.artifacts[spec.name]
                learned = TrainedSubject(registered, maps, trained, self.artifacts.get(FIT_CLOTH.name))
                methods[name] = TrainedMethod(learned.outfit(), self.config.drive, learned.exposures)
        if "baseline" in self.config.methods:
            betas = load_poses(registered.file("smpl_params.npz"), self.body).betas
            baseline = Baseline.load(self.artifacts[SEGMENT_LAYERS.name], self.body, betas)
            methods["baseline"] = BaselineMethod(baseline, self.config.supersampling)
        return methods

    def _description(self, name: str) -> dict[str, Any]:
        """Which training a method is."""
        trained = self.artifacts[_LEARNED[name].name]
        facts = ("method", "without", "steps", "gaussians")
        return {"key": trained.key, **{fact: trained.summary.get(fact) for fact in facts}}

    def _measure_vertices(self, folder: Path, report: Report) -> dict[str, Any]:
        """Compare the learned garments, and their texels moved by the bones alone, with the true meshes."""
        learned = {name: m for name, m in self.methods.items() if isinstance(m, TrainedMethod)}
        takes = [*self.capture.training_takes, *self.capture.test_takes]
        summary = self.artifacts[REGISTER_TEMPLATE.name].summary
        template = self.capture.take(str(summary["take"])), int(summary["frame"])
        errors, rows = vertex_errors(self.splits, self.meshes, _posings(learned, takes), template, report)
        write_whole(folder / "vertices.json", readable_json(rows))
        return errors


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


def _artifacts(workspace: Workspace, registered: Artifact, config: EvaluateConfig) -> dict[str, Artifact]:
    """What the methods are made from, by stage."""
    artifacts = {REGISTER_TEMPLATE.name: registered}
    for name, spec in _LEARNED.items():
        if name in config.methods:
            artifacts[BAKE_MAPS.name] = workspace.require(BAKE_MAPS)
            artifacts[spec.name] = chosen_training(
                workspace, spec, config.training if name == "trained" else ""
            )
            cloth = fitted_cloth(workspace)
            if cloth is not None and not config.training:
                artifacts[FIT_CLOTH.name] = cloth
    if "baseline" in config.methods:
        artifacts[SEGMENT_LAYERS.name] = workspace.require(SEGMENT_LAYERS)
    return artifacts


def _true_meshes(files: Sequence[str], capture: Capture, config: EvaluateConfig) -> dict[str, TrueMeshes]:
    """Take to true meshes; refused where nothing that was learned is scored."""
    if files and not {"trained", "distilled"} & set(config.methods):
        raise UsageProblem(
            "True meshes are compared with what was trained, and that is not scored.",
            "options --true-meshes and --methods",
            "Add trained to --methods.",
        )
    return true_meshes_of(list(files), capture)


def _posings(methods: dict[str, TrainedMethod], takes: list[Take]) -> dict[str, Posing]:
    """How every method poses garments in a take, and the bones alone."""

    def in_take(method: TrainedMethod) -> PosedLayers:
        def posed(poses: Poses, frame: int) -> dict[str, PosedGaussians]:
            take = next((take for take in takes if take.poses is poses), None)
            return method.outfit.posed(poses, frame) if take is None else method.posed(take, frame)

        return posed

    outfits = {name: method.outfit for name, method in methods.items()}
    return posings_of(outfits, {name: in_take(method) for name, method in methods.items()})

"""Train: learn every layer's Gaussians and how they depend on the pose, from multi-view video.

Reads:
    register-template: `smpl_params.npz` poses of the training take; `body.safetensors` body model.
    bake-maps: `<layer>.safetensors` maps of each layer that is there.
    the capture: images, masks and labels of the training take.
    a file of perceptual weights (docs/formats.md), if one is given.
Writes:
    `<layer>.safetensors`: base attributes (N, …) f32 per texel and network weights (`TexelAttributes.state`).
    `model.json`: {"layers": {name: `TexelAttributes.config`}}, inner to outer.
    `metrics.jsonl`: one line per few steps: losses, gradient norm, seconds by part.
    `previews/*.png`: truth | render | labels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, TRAIN
from stages.shared.artifacts import Artifact, ExternalFiles, Progress, Workspace
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.result import StageResult
from stages.shared.avatar.decoder import new_model
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel
from stages.shared.capture import LAYERS, Capture, Take
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.losses.perceptual import SMALLEST_SIDE, Perceptual
from stages.shared.plan import Plan
from stages.shared.poses import load_poses
from stages.shared.report import SILENT, Report
from stages.train import checkpoint, cost
from stages.train.checkpoint import METRICS_NAME, RunState
from stages.train.config import METHODS, TrainConfig
from stages.train.data import TrainingViews
from stages.train.loop import learn
from stages.train.memory import available_bytes, memory_named, say_if_scarce
from stages.train.method import MethodLayers, method_layers, settled
from stages.train.trainer import Trainer
from stages.train.watch import Watch


def run(
    subject: Path,
    config: TrainConfig | None = None,
    report: Report = SILENT,
    force: bool = False,
    perceptual_weights: Path | None = None,
    watch: Watch | None = None,
) -> StageResult:
    """Train the layers of a subject; an interrupted run of the same configuration goes on where it stopped.

    Without `perceptual_weights` the LPIPS terms are off. `watch` is shown the outfit while it learns.

    Raises:
        MissingInput: an earlier stage has not run. BadData: three steps in a row were not finite.
        KeyboardInterrupt: after Ctrl-C, with a checkpoint written.
    """
    config = _with_digest(config or TrainConfig(), perceptual_weights)
    weights = settled(config).weights
    workspace = Workspace(subject)
    source = _open(workspace)
    inputs = source.inputs
    found = None if force else workspace.find(TRAIN, config, inputs)
    if found is not None:
        report.say("up to date")
        return StageResult(found, found.summary)
    report.step("read")
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    if perceptual is None and max(weights.lpips, weights.face) > 0:
        report.say("no perceptual weights given: the LPIPS terms are off")
    needed = cost.memory_bytes(source.layers(config.method).maps, settled(config))
    say_if_scarce(needed, available_bytes(), report)
    with memory_named(needed):
        trainer = _trainer(source, config, _device(config.device), perceptual)
    with memory_named(needed), workspace.progress(TRAIN, config, inputs, force=force) as progress:
        state = checkpoint.restore(progress, trainer)
        if state.step:
            report.say(f"going on from step {state.step}")
        elif state.tracked > 0:
            report.say(f"going on from frame {state.tracked} of tracking")
        if watch is not None:
            watch.layer_ids = source.layers(config.method).layer_ids
        learn(trainer, progress, state, report, watch)
        trainer.finish()
        report.step("write")
        with workspace.build(TRAIN, config, inputs, force=force) as build:
            for name, model in trainer.models.items():
                build.write_arrays(f"{name}.safetensors", {k: v.numpy() for k, v in model.state().items()})
            for name, arrays in source.own_maps(config.method).items():
                build.write_arrays(f"maps-{name}.safetensors", arrays)
            models = {name: model.config for name, model in trainer.models.items()}
            build.write_json("model.json", {"layers": models, "method": config.method})
            build.write_bytes(METRICS_NAME, (progress.path / METRICS_NAME).read_bytes())
            for picture in sorted((progress.path / "previews").glob("*.png")):
                build.write_bytes(f"previews/{picture.name}", picture.read_bytes())
            build.summary(**_summary(trainer, state, progress))
            build.measured(training_seconds=round(state.elapsed, 1))
    return StageResult(build.artifact, build.artifact.summary)


def plan(subject: Path, config: TrainConfig | None = None, perceptual_weights: Path | None = None) -> Plan:
    """Inputs, outputs and cost of `run`; reads the maps, writes nothing."""
    config = _with_digest(config or TrainConfig(), perceptual_weights)
    _device(config.device)
    workspace = Workspace(subject)
    source = _open(workspace)
    maps = source.layers(config.method).maps
    weights = [str(perceptual_weights)] if perceptual_weights else []
    return Plan(
        inputs=[str(source.registered.path), str(source.baked.path), str(source.capture.root), *weights],
        outputs=[f"{workspace.root / TRAIN.name}/<key>/{name}.safetensors" for name in maps],
        config=asdict(config),
        seconds=cost.seconds(maps, settled(config), _tracked_views(source.take, settled(config))),
        memory_bytes=cost.memory_bytes(maps, settled(config)),
        disk_bytes=cost.disk_bytes(maps, settled(config)),
    )


def prepare(
    subject: Path, config: TrainConfig, change: Callable[[LayerMaps], LayerMaps] | None = None
) -> Trainer:
    """The trainer with which `run` would begin, without LPIPS; for measuring.

    `change` makes other maps of every layer's.
    """
    return _trainer(_open(Workspace(subject)), config, _device(config.device), None, change)


@dataclass(frozen=True)
class _Source:
    """Everything the stage reads."""

    registered: Artifact
    baked: Artifact
    capture: Capture
    take: Take

    @property
    def inputs(self) -> dict[str, Artifact | ExternalFiles]:
        groups = ("cameras", "images", "masks", "labels")
        files = {f"capture/{group}": self.capture.files(group, "train") for group in groups}
        return {
            "register-template": self.registered,
            "bake-maps": self.baked,
            **{name: ExternalFiles(name, self.capture.root, paths) for name, paths in files.items() if paths},
        }

    def maps(self) -> dict[str, LayerMaps]:
        """Maps of the layers that are there, inner to outer."""
        layers = [name for name in LAYERS if name in self.baked.summary["layers"]]
        return {name: LayerMaps.load(self.baked, name) for name in layers}

    def layers(self, method: str) -> MethodLayers:
        """What a method learns, made from those maps."""
        betas = load_poses(self.registered.file("smpl_params.npz")).betas
        return method_layers(method, self.maps(), torch.from_numpy(betas))

    def own_maps(self, method: str) -> dict[str, dict[str, np.ndarray]]:
        """Arrays of the maps that only this method has, by layer; none for the layers of bake-maps."""
        if method == METHODS[0]:
            return {}
        layers = self.layers(method)
        found = {name: maps.arrays() for name, maps in layers.maps.items()}
        for name, ids in layers.layer_ids.items():
            found[name]["layer_ids"] = ids.numpy().astype(np.int32)
        return found


def _open(workspace: Workspace) -> _Source:
    registered, baked = workspace.require(REGISTER_TEMPLATE), workspace.require(BAKE_MAPS)
    body = BodyModel.from_arrays(registered.arrays("body.safetensors"))
    capture = open_subject_capture(workspace, body)
    name = registered.summary.get("take")
    takes = {take.name: take for take in capture.training_takes}
    if name not in takes:
        raise MissingInput(
            f"The capture has no training take called {name!r} any more.",
            str(capture.root),
            "Register the subject again with `gw register-template`.",
        )
    return _Source(registered, baked, capture, takes[name])


def _with_digest(config: TrainConfig, perceptual_weights: Path | None) -> TrainConfig:
    """The configuration with what names the perceptual weights, so that others give another artifact."""
    if perceptual_weights is None:
        return replace(config, perceptual_digest="")
    if config.perceptual_side < SMALLEST_SIDE:
        raise UsageProblem(
            f"LPIPS cannot see crops of {config.perceptual_side} pixels.",
            "perceptual_side",
            f"Choose at least {SMALLEST_SIDE}.",
        )
    return replace(config, perceptual_digest=file_digest(perceptual_weights))


def _device(name: str) -> torch.device:
    if name not in ("auto", "cpu", "cuda"):
        raise UsageProblem(f"There is no device {name!r}.", "option --device", "Choose auto, cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageProblem("No CUDA device was found.", "option --device", "Use --device cpu.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _tracked_views(take: Take, config: TrainConfig) -> int:
    """Pictures through which garments are followed."""
    config = cost.affordable_tracking(config, len(take.frames), len(take.training_cameras))
    frames = take.frames[:: config.track.frame_step] if config.track.frame_step else []
    return len(frames) * len(take.training_cameras)


def _trainer(
    source: _Source,
    config: TrainConfig,
    device: torch.device,
    perceptual: Perceptual | None,
    change: Callable[[LayerMaps], LayerMaps] | None = None,
) -> Trainer:
    body = BodyModel.from_arrays(source.registered.arrays("body.safetensors"))
    poses = load_poses(source.registered.file("smpl_params.npz"), body)
    config, maps = settled(config), source.layers(config.method).maps
    if change is not None:
        maps = {name: change(layer) for name, layer in maps.items()}
    if len(poses) <= max(source.take.frames, default=0):
        raise BadData(
            f"There are {len(poses)} poses, but images up to frame {source.take.frames[-1]}.",
            str(source.registered.path / "smpl_params.npz"),
            "Register the subject again with `gw register-template`.",
        )
    config = cost.affordable_tracking(config, len(source.take.frames), len(source.take.training_cameras))
    views = TrainingViews(source.take, poses, body, list(maps))
    frames = len(views.frames(config.track.frame_step or config.frame_step))
    anchors = (
        frames if config.track.frame_step and config.model.anchors else min(config.model.anchors, frames)
    )
    shape = replace(config.model, anchors=anchors)
    models = {
        name: new_model(layer.to(device), shape, frames, seed=config.seed + index).to(device)
        for index, (name, layer) in enumerate(maps.items())
    }
    template_frame = int(source.registered.summary.get("frame", 0))
    return Trainer(config, models, views, device, perceptual, template_frame)


def _summary(trainer: Trainer, state: RunState, progress: Progress) -> dict[str, Any]:
    lines = progress.lines(METRICS_NAME)
    return {
        "method": trainer.config.method,
        "without": list(trainer.config.without),
        "layers": list(trainer.models),
        "gaussians": sum(len(model.maps) for model in trainer.models.values()),
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "frames": len(trainer.frames),
        "steps": state.step,
        "skipped": state.skipped,
        "losses": lines[-1]["losses"] if lines else {},
    }

"""Train: learn every layer's Gaussians and how they depend on the pose, from multi-view video.

Reads:
    register-template: `smpl_params.npz` poses of the template's take; `body.safetensors` body model.
    bake-maps: `<layer>.safetensors` maps of each layer that is there.
    the capture: images, masks and labels of the takes that are learned from, poses of the other takes.
    a file of perceptual weights (docs/formats.md), if one is given.
    another subject's training and maps, if layers start from there (`warm_start.py`).
Writes:
    `<layer>.safetensors`: base attributes (N, …) f32 per texel and decoder weights (`Decoder.state`).
    `model.json`: {"layers": {name: `Decoder.config`}}, inner to outer; "grids" of maps that differ.
    `maps-<layer>.safetensors`: of layers with other maps than those of bake-maps.
    `exposure.json`: {camera: {"gain", "offset"}} of cameras that differ from the others (`exposure.py`).
    `metrics.jsonl`: one line per few steps: losses, gradient norm, seconds by part.
    `previews/*.png`: truth | render | labels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from stages.pipeline import TRAIN
from stages.shared.artifacts import Artifact, Progress, Workspace, require_room
from stages.shared.artifacts.build import Build
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.spec import StageResult
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.cost import costs
from stages.shared.avatar.decoders.registry import new_decoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.capture.exposure import exposures_json
from stages.shared.determinism import deterministic_sums
from stages.shared.errors import UsageProblem
from stages.shared.losses.perceptual import SMALLEST_SIDE, Perceptual
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.train import checkpoint, estimate
from stages.train.checkpoint import METRICS_NAME, RunState
from stages.train.config import TrainConfig
from stages.train.distributed import ALONE, Processes, Unwritten, device_called, for_all
from stages.train.estimate import guard_memory
from stages.train.loop import learn
from stages.train.monitor import IntervalCallback
from stages.train.reporting import require_tensorboard, tensorboard_logger
from stages.train.resolve import resolve, smaller_runs
from stages.train.source import Source, open_source
from stages.train.trainer import Trainer
from stages.train.views import TrainingViews
from stages.train.warm_start import pretrained_decoder, warm_started


def run(
    subject: Path,
    config: TrainConfig | None = None,
    report: Report = SILENT,
    force: bool = False,
    perceptual_weights: Path | None = None,
    watch: IntervalCallback | None = None,
    from_subject: Path | None = None,
    tensorboard: bool = False,
    processes: Processes = ALONE,
) -> StageResult:
    """Train the layers of a subject. An interrupted run of the same configuration continues where it stopped.

    Arguments:
        perceptual_weights: weights of LPIPS; without them its terms are off.
        watch: is called with the outfit at given times.
        from_subject: a trained subject from which layers start; its body stays as it is.
        tensorboard: metrics and previews also go to `SUBJECT/tensorboard/train-<key>`.
        processes: that share the run (`distributed.py`). The first writes; the others help it.

    Raises:
        MissingInput: an earlier stage has not run. BadData: three steps in a row were not finite.
        KeyboardInterrupt: after Ctrl-C, with a checkpoint written.
    """
    if tensorboard:
        require_tensorboard()
    config = for_all(_with_digest(config or TrainConfig(), perceptual_weights), processes)
    workspace = Workspace(subject)
    source = open_source(workspace, config, from_subject)
    artifact = _finished(workspace, config, source, force, processes)
    if artifact is not None:
        report.say("up to date")
        return StageResult(artifact, artifact.summary)
    report.step("read")
    resolved, device = resolve(config, source), device_called(config.device)
    _say_what_differs(report, source, resolved, perceptual_weights)
    require_room(workspace.root, estimate.disk_bytes(source.layers.maps, resolved))
    out_of_memory = guard_memory(resolved, source, device, lambda: smaller_runs(resolved, source))
    with out_of_memory, deterministic_sums(device):
        trainer = make_trainer(source, resolved, device, perceptual_weights, processes)
        with _progress_folder(workspace, config, source, force, processes) as progress:
            state = checkpoint.resume(progress, trainer, report)
            _learn(trainer, progress, state, report, watch, workspace.root if tensorboard else None, source)
            if processes.first:
                report.step("write")
                with workspace.build(TRAIN, config, source.inputs, force=force) as build:
                    _write(build, source, trainer, state, progress)
            processes.turn()  # the others wait until the first has written
            artifact = build.artifact if processes.first else workspace.require(TRAIN)
    return StageResult(artifact, artifact.summary)


def plan(
    subject: Path,
    config: TrainConfig | None = None,
    perceptual_weights: Path | None = None,
    from_subject: Path | None = None,
) -> Plan:
    """Inputs, outputs and cost of `run`; reads the maps, writes nothing."""
    config = _with_digest(config or TrainConfig(), perceptual_weights)
    device_called(config.device)
    workspace = Workspace(subject)
    source = open_source(workspace, config, from_subject)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    maps, resolved = source.layers.maps, resolve(config, source)
    extent, frames = estimate.extent_of(source.sequence, resolved), source.sequence.every(resolved.frame_step)
    others = [str(path) for path in (perceptual_weights, from_subject) if path]
    return Plan(
        inputs=[str(source.registered.path), str(source.baked.path), str(source.capture.root), *others],
        outputs=[f"{workspace.root / TRAIN.name}/<key>/{name}.safetensors" for name in maps],
        config=asdict(
            replace(
                config,
                frame_step=resolved.frame_step,
                track=replace(config.track, scale=resolved.track.scale),
            )
        ),
        seconds=estimate.seconds(maps, resolved, extent),
        memory_bytes=estimate.memory_bytes(maps, resolved, extent),
        disk_bytes=estimate.disk_bytes(maps, resolved),
        scene=estimate.scene_requirements(maps, source.body, source.poses, frames, resolved),
    )


def prepare(
    subject: Path,
    config: TrainConfig,
    change: Callable[[LayerMaps], LayerMaps] | None = None,
    from_subject: Path | None = None,
) -> Trainer:
    """The trainer with which `run` would start, without LPIPS; for measuring.

    `change` replaces the maps of every layer.
    """
    source = open_source(Workspace(subject), config, from_subject)
    if change is not None:
        maps = {name: change(layer) for name, layer in source.layers.maps.items()}
        source = replace(source, layers=replace(source.layers, maps=maps))
    return make_trainer(source, resolve(config, source), device_called(config.device))


def _finished(
    workspace: Workspace, config: TrainConfig, source: Source, force: bool, processes: Processes
) -> Artifact | None:
    """The artifact of this configuration, where it is there; all processes agree on it."""
    artifact = None
    if processes.first and not force:
        artifact = workspace.find(TRAIN, config, source.inputs)
    if not processes.turn(stop=artifact is not None).stop:
        return None
    return artifact or workspace.require(TRAIN)


def _progress_folder(
    workspace: Workspace, config: TrainConfig, source: Source, force: bool, processes: Processes
) -> Progress:
    """The folder of the unfinished run; the other processes write nowhere."""
    if not processes.first:
        return Unwritten()
    return workspace.progress(TRAIN, config, source.inputs, force=force)


def make_trainer(
    source: Source,
    config: TrainConfig,
    device: torch.device,
    perceptual_weights: Path | None = None,
    processes: Processes = ALONE,
) -> Trainer:
    """The trainer of a resolved configuration before its first step."""
    layers, start = source.layers.maps, source.warm_start
    poses = len(source.sequence.every(config.track.frame_step or config.frame_step))
    pretrained = {name: pretrained_decoder(layer, device) for name, layer in start.layers.items()}
    models: dict[str, Decoder] = {}
    for index, (name, maps) in enumerate(layers.items()):
        if name in start.frozen:
            models[name] = pretrained[name]
        elif name in start.layers:
            models[name] = warm_started(start.layers[name], config.model, device)
        else:
            models[name] = new_decoder(maps.to(device), config.model, poses, config.seed + index).to(device)
    exposures = source.exposures(config)
    views = TrainingViews(source.sequence, source.poses, source.body, list(layers), source.method, exposures)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    return Trainer(config, models, views, device, perceptual, source.template_frame, pretrained, processes)


def _learn(
    trainer: Trainer,
    progress: Progress,
    state: RunState,
    report: Report,
    watch: IntervalCallback | None,
    tensorboard_root: Path | None,
    source: Source,
) -> None:
    """All steps, and what follows the last one. The first process reports to TensorBoard and to `watch`."""
    first = trainer.processes.first
    if watch is not None:
        watch.layer_ids = source.layers.layer_ids
    with tensorboard_logger(tensorboard_root if first else None, progress, state.step, report) as board:
        learn(trainer, progress, state, report, watch if first else None, board)
    if differ := trainer.views.exposures:
        report.say(f"colours of {', '.join(differ)} differ from the other cameras'; this is taken out")
    if blank := trainer.views.blank_views():
        report.warn(f"views that show nobody were left out ({blank})")
    if first:
        trainer.finish()
        trainer.fill_unobserved()


def _say_what_differs(
    report: Report, source: Source, resolved: TrainConfig, perceptual_weights: Path | None
) -> None:
    """Warnings of the warm start, the frames that are learned from, and terms of the loss that are off."""
    for warning in source.warm_start.warnings:
        report.warn(warning)
    learned, frames = source.sequence.every(resolved.frame_step), source.sequence.frames
    report.say(f"learning from {len(learned)} of {len(frames)} frames ({source.poses.fps:g} per second)")
    if perceptual_weights is None and max(resolved.weights.lpips, resolved.weights.face) > 0:
        report.say("no perceptual weights given: the LPIPS terms are off")


def _with_digest(config: TrainConfig, perceptual_weights: Path | None) -> TrainConfig:
    """The configuration with the digest of the perceptual weights, so that others give another artifact."""
    if perceptual_weights is None:
        return replace(config, perceptual_digest="")
    if config.perceptual_side < SMALLEST_SIDE:
        raise UsageProblem(
            f"LPIPS cannot see crops of {config.perceptual_side} pixels.",
            "perceptual_side",
            f"Choose at least {SMALLEST_SIDE}.",
        )
    return replace(config, perceptual_digest=file_digest(perceptual_weights))


def _write(build: Build, source: Source, trainer: Trainer, state: RunState, progress: Progress) -> None:
    """All files of the artifact, and its summary."""
    for name, model in trainer.models.items():
        build.write_arrays(f"{name}.safetensors", {k: v.numpy() for k, v in model.state().items()})
    for name, arrays in source.maps_to_store().items():
        build.write_arrays(f"maps-{name}.safetensors", arrays)
    configs = {name: model.config for name, model in trainer.models.items()}
    grids = {"grids": source.warm_start.grids} if source.warm_start.layers else {}
    build.write_json("model.json", {"layers": configs, "method": trainer.config.method, **grids})
    build.write_json("exposure.json", exposures_json(trainer.views.exposures))
    build.write_record(METRICS_NAME, (progress.path / METRICS_NAME).read_bytes())
    for picture in sorted((progress.path / "previews").glob("*.png")):
        build.write_record(f"previews/{picture.name}", picture.read_bytes())
    build.summary(**_summary(trainer, source, state, progress))
    build.measured(training_seconds=round(state.elapsed, 1))


def _summary(trainer: Trainer, source: Source, state: RunState, progress: Progress) -> dict[str, Any]:
    lines, views, start = progress.lines(METRICS_NAME), trainer.views, source.warm_start
    takes = [take.name for take in views.sequence.takes]
    started = {"started": list(start.layers), "frozen": list(start.frozen)} if start.layers else {}
    resting = estimate.resting_joints(views.body, views.poses, trainer.frames)
    maps = {name: model.maps for name, model in trainer.models.items()}
    return {
        **started,
        "method": trainer.config.method,
        "without": list(trainer.config.without),
        "layers": list(trainer.models),
        "gaussians": sum(len(layer) for layer in maps.values()),
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "frames": len(trainer.frames),
        "frame_step": trainer.config.frame_step,
        **({"takes": takes} if len(takes) > 1 else {}),
        "steps": state.step,
        "skipped": state.skipped,
        "losses": lines[-1]["losses"] if lines else {},
        "costs": {name: costs(model, tuple(resting)) for name, model in trainer.models.items()},
        "left_out": estimate.left_out(maps, resting, trainer.config),
    }

"""Train: learn every layer's Gaussians and how they depend on the pose, from multi-view video.

Reads:
    register-template: `smpl_params.npz` poses of the template's take; `body.safetensors` body model.
    bake-maps: `<layer>.safetensors` maps of each layer that is there.
    the capture: images, masks and labels of the takes that are learned from, poses of the other takes.
    a file of perceptual weights (docs/formats.md), if one is given.
    another subject's training and maps, if layers start from there (`stages/train/start.py`).
Writes:
    `<layer>.safetensors`: base attributes (N, …) f32 per texel and network weights (`Decoder.state`).
    `model.json`: {"layers": {name: `Decoder.config`}}, inner to outer; "grids" of own maps.
    `maps-<layer>.safetensors`: of layers with other maps than those of bake-maps.
    `metrics.jsonl`: one line per few steps: losses, gradient norm, seconds by part.
    `previews/*.png`: truth | render | labels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from stages.pipeline import TRAIN
from stages.shared.artifacts import Progress, Workspace, require_room
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.result import StageResult
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import new_decoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.body import BodyModel
from stages.shared.device import check_device
from stages.shared.errors import UsageProblem
from stages.shared.losses.perceptual import SMALLEST_SIDE, Perceptual
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.train import board, checkpoint, cost
from stages.train.begin import begun_model, known_model
from stages.train.board import Board
from stages.train.checkpoint import METRICS_NAME, RunState
from stages.train.config import TrainConfig
from stages.train.data import TrainingViews
from stages.train.distributed import ALONE, Processes, Unwritten, for_all, local_rank, on_this_machine
from stages.train.extent import Extent, extent_of
from stages.train.footprint import anchors_of, memory_bytes, smaller_runs
from stages.train.loop import learn
from stages.train.memory import available_bytes, memory_named, refuse_if_scarce
from stages.train.methods.registry import method_called
from stages.train.requirements import scene_requirements, what_it_took
from stages.train.resolve import resolve_settings
from stages.train.source import Source, open_source
from stages.train.start import Start
from stages.train.trainer import Trainer
from stages.train.watch import Watch


def run(
    subject: Path,
    config: TrainConfig | None = None,
    report: Report = SILENT,
    force: bool = False,
    perceptual_weights: Path | None = None,
    watch: Watch | None = None,
    from_subject: Path | None = None,
    tensorboard: bool = False,
    processes: Processes = ALONE,
) -> StageResult:
    """Train the layers of a subject; an interrupted run of the same configuration goes on where it stopped.

    Without `perceptual_weights` the LPIPS terms are off. `watch` is shown the outfit while it learns. With
    `from_subject`, layers begin as that trained subject has them, and its body stays as it is. With
    `tensorboard`, metrics and previews also go to `SUBJECT/tensorboard/train-<key>`. Of several
    `processes` (`stages/train/distributed.py`) the first writes, and the others help it.

    Raises:
        MissingInput: an earlier stage has not run. BadData: three steps in a row were not finite.
        KeyboardInterrupt: after Ctrl-C, with a checkpoint written.
    """
    config = for_all(_with_digest(config or TrainConfig(), perceptual_weights), processes)
    if tensorboard:
        board.require()
    weights = resolve_settings(config).weights
    workspace = Workspace(subject)
    source = open_source(workspace, config, from_subject)
    inputs = source.inputs
    found = None if force or not processes.first else workspace.find(TRAIN, config, inputs)
    if processes.turn(stop=found is not None).stop:
        found = found or workspace.require(TRAIN)
        report.say("up to date")
        return StageResult(found, found.summary)
    report.step("read")
    for warning in source.start.warnings:
        report.warn(warning)
    perceptual = Perceptual.load(perceptual_weights) if perceptual_weights else None
    if perceptual is None and max(weights.lpips, weights.face) > 0:
        report.say("no perceptual weights given: the LPIPS terms are off")
    device, room = _device(config.device), available_bytes()
    maps = source.layers(config.method).maps
    extent = extent_of(source.footage, resolve_settings(config))
    needed = memory_bytes(maps, resolve_settings(config), extent)
    require_room(workspace.root, _disk_bytes(maps, resolve_settings(config), extent))

    def fixes() -> dict[str, int]:
        return smaller_runs(maps, resolve_settings(config), source.footage)

    if device.type == "cpu":
        refuse_if_scarce(needed, room // on_this_machine() if room else None, fixes)
    with memory_named(needed, fixes):
        trainer = _trainer(source, config, device, perceptual, processes=processes)
    folder = workspace.progress(TRAIN, config, inputs, force=force) if processes.first else Unwritten()
    with memory_named(needed, fixes), folder as progress:
        state = checkpoint.restore(progress, trainer)
        checkpoint.spread(trainer, state)
        if state.step:
            report.say(f"going on from step {state.step}")
        elif state.tracked > 0:
            report.say(f"going on from frame {state.tracked} of tracking")
        if watch is not None:
            watch.layer_ids = source.layers(config.method).layer_ids
        wanted = tensorboard and processes.first
        with _board(workspace, progress, state, wanted, report) as shown:
            learn(trainer, progress, state, report, watch if processes.first else None, shown)
        if not processes.first:
            processes.turn()  # until the first has written
            found = workspace.require(TRAIN)
            return StageResult(found, found.summary)
        trainer.finish()
        trainer.fill_unobserved()
        report.step("write")
        with workspace.build(TRAIN, config, inputs, force=force) as build:
            for name, model in trainer.models.items():
                build.write_arrays(f"{name}.safetensors", {k: v.numpy() for k, v in model.state().items()})
            for name, arrays in source.own_maps(config.method).items():
                build.write_arrays(f"maps-{name}.safetensors", arrays)
            models = {name: model.config for name, model in trainer.models.items()}
            grids = {"grids": source.start.grids} if source.start.layers else {}
            build.write_json("model.json", {"layers": models, "method": config.method, **grids})
            build.write_record(METRICS_NAME, (progress.path / METRICS_NAME).read_bytes())
            for picture in sorted((progress.path / "previews").glob("*.png")):
                build.write_record(f"previews/{picture.name}", picture.read_bytes())
            build.summary(**_summary(trainer, source.start, state, progress))
            build.measured(training_seconds=round(state.elapsed, 1))
        processes.turn()
    return StageResult(build.artifact, build.artifact.summary)


def plan(
    subject: Path,
    config: TrainConfig | None = None,
    perceptual_weights: Path | None = None,
    from_subject: Path | None = None,
) -> Plan:
    """Inputs, outputs and cost of `run`; reads the maps, writes nothing."""
    config = _with_digest(config or TrainConfig(), perceptual_weights)
    _device(config.device)
    workspace = Workspace(subject)
    source = open_source(workspace, config, from_subject)
    if perceptual_weights:
        Perceptual.load(perceptual_weights)
    maps, chosen = source.layers(config.method).maps, resolve_settings(config)
    body = BodyModel.from_arrays(source.registered.arrays("body.safetensors"))
    extent = extent_of(source.footage, chosen)
    given = [str(path) for path in (perceptual_weights, from_subject) if path]
    return Plan(
        inputs=[str(source.registered.path), str(source.baked.path), str(source.capture.root), *given],
        outputs=[f"{workspace.root / TRAIN.name}/<key>/{name}.safetensors" for name in maps],
        config=asdict(config),
        seconds=cost.seconds(maps, chosen, extent.tracked_views),
        memory_bytes=memory_bytes(maps, chosen, extent),
        disk_bytes=_disk_bytes(maps, chosen, extent),
        scene=scene_requirements(maps, body, source.poses, source.footage.every(config.frame_step), chosen),
    )


def prepare(
    subject: Path,
    config: TrainConfig,
    change: Callable[[LayerMaps], LayerMaps] | None = None,
    from_subject: Path | None = None,
) -> Trainer:
    """The trainer with which `run` would begin, without LPIPS; for measuring.

    `change` makes other maps of every layer's.
    """
    source = open_source(Workspace(subject), config, from_subject)
    return _trainer(source, config, _device(config.device), None, change)


@contextmanager
def _board(
    workspace: Workspace, progress: Progress, state: RunState, wanted: bool, report: Report
) -> Iterator[Board | None]:
    """Where metrics go for TensorBoard; outside of the artifact, which they do not belong to."""
    if not wanted:
        yield None
        return
    folder = workspace.root / "tensorboard" / f"{TRAIN.name}-{progress.path.name.rpartition('-')[2]}"
    report.say(f"tensorboard --logdir {folder}")
    opened = Board(folder, state.step)
    try:
        yield opened
    finally:
        opened.close()


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
    check_device(name)
    on_gpu = name != "cpu" and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")


def _trainer(
    source: Source,
    config: TrainConfig,
    device: torch.device,
    perceptual: Perceptual | None,
    change: Callable[[LayerMaps], LayerMaps] | None = None,
    processes: Processes = ALONE,
) -> Trainer:
    body = BodyModel.from_arrays(source.registered.arrays("body.safetensors"))
    footage = source.footage
    config, maps = resolve_settings(config), source.layers(config.method).maps
    if change is not None:
        maps = {name: change(layer) for name, layer in maps.items()}
    config = cost.affordable_tracking(config, len(footage.frames), len(footage.training_cameras))
    views = TrainingViews(footage, source.poses, body, list(maps), method_called(config.method))
    frames = len(views.frames(config.track.frame_step or config.frame_step))
    anchors = (
        frames if config.track.frame_step and config.model.anchors else min(config.model.anchors, frames)
    )
    shape, start = replace(config.model, anchors=anchors), source.start
    known = {name: known_model(worn, device) for name, worn in start.layers.items()}
    models: dict[str, Decoder] = {}
    for index, (name, layer) in enumerate(maps.items()):
        if name in start.frozen:
            models[name] = known[name]
        elif name in start.layers:
            models[name] = begun_model(start.layers[name], shape, device)
        else:
            models[name] = new_decoder(layer.to(device), shape, frames, seed=config.seed + index).to(device)
    config = replace(config, weights=start.weights(config.weights))
    template_frame = int(source.registered.summary.get("frame", 0))
    return Trainer(config, models, views, device, perceptual, template_frame, known, processes)


def _disk_bytes(maps: dict[str, LayerMaps], chosen: TrainConfig, extent: Extent) -> int:
    """Estimate of what a run of the `chosen`, resolved configuration writes."""
    return cost.disk_bytes(cost.parameters(maps, chosen, anchors_of(chosen, extent)))


def _summary(trainer: Trainer, start: Start, state: RunState, progress: Progress) -> dict[str, Any]:
    lines = progress.lines(METRICS_NAME)
    takes = [take.name for take in trainer.views.footage.takes]
    begun = {"started": list(start.layers), "frozen": list(start.frozen)} if start.layers else {}
    return {
        **begun,
        "method": trainer.config.method,
        "without": list(trainer.config.without),
        "layers": list(trainer.models),
        "gaussians": sum(len(model.maps) for model in trainer.models.values()),
        "parameters": sum(parameter.numel() for parameter in trainer.parameters.values()),
        "frames": len(trainer.frames),
        **({"takes": takes} if len(takes) > 1 else {}),
        "steps": state.step,
        "skipped": state.skipped,
        "losses": lines[-1]["losses"] if lines else {},
        **what_it_took(trainer),
    }

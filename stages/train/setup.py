"""The trainer of a run, made from what is read and the resolved configuration."""

from __future__ import annotations

from pathlib import Path

import torch

from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.registry import new_decoder
from stages.shared.device import check_device
from stages.shared.losses.perceptual import Perceptual
from stages.train.config import TrainConfig
from stages.train.distributed import ALONE, Processes, local_rank
from stages.train.pretrained import pretrained_decoder, warm_started
from stages.train.source import Source
from stages.train.trainer import Trainer
from stages.train.views import TrainingViews


def device_called(name: str) -> torch.device:
    """The device of this process: "auto" and "cuda" take a GPU where there is one.

    Raises UsageProblem for an unknown device.
    """
    check_device(name)
    on_gpu = name != "cpu" and torch.cuda.is_available()
    return torch.device("cuda", local_rank()) if on_gpu else torch.device("cpu")


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
            seed = config.seed + index
            models[name] = new_decoder(maps.to(device), config.model, poses, seed).to(device)
    views = TrainingViews(source.sequence, source.poses, source.body, list(layers), source.method)
    return Trainer(
        config,
        models,
        views,
        device,
        Perceptual.load(perceptual_weights) if perceptual_weights else None,
        source.template_frame,
        pretrained,
        processes,
    )

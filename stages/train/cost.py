"""What a run will cost, before it starts; estimates for two CPU cores."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.positional import network_grid
from stages.shared.nets.styleunet import StyleUNet, ViewNet
from stages.train.config import TrainConfig

# Measured on two cores, forward and backward: per Gaussian and camera and per camera (512² images), per
# Gaussian (deformation and surface terms), per network whatever its size, and per weight and input pixel.
_SECONDS_PER_GAUSSIAN_SEEN = 0.6e-6
_SECONDS_PER_PICTURE = 0.02
_SECONDS_PER_GAUSSIAN = 1.5e-6
_SECONDS_PER_NETWORK = 0.05
_SECONDS_PER_WEIGHT_PIXEL = 1.2e-12
_SECONDS_PER_BASIS_NUMBER = 8e-9  # reckoned: seven passes over memory (there, back, Adam) at 4 GB/s
_SECONDS_PER_TRACKED_VIEW = 0.15  # a frame in one camera, all rounds
# Reckoned, not measured: VGG-16 there, back, and once for the truth at 100 GFLOP/s.
_SECONDS_PER_PERCEIVED_PIXEL = 1.8e-5
_TRACKING_SHARE = 1 / 3
_FLOAT = 4


def parameters(maps: dict[str, LayerMaps], config: TrainConfig, anchors: int = 0) -> int:
    """Learned numbers of all layers, `anchors` of which garments have where the model has any."""
    base = 14 * sum(len(layer) for layer in maps.values()) if config.model.base else 0
    if config.model.decoder == "blendshapes":
        return base + sum(len(layer) for layer in maps.values()) * _basis_numbers(config.model)
    cells = sum(_anchor_cells(layer, config.model) for layer in maps.values() if layer.layer != "body")
    networks = sum(sum(network_parameters(layer, config.model)) for layer in maps.values())
    return base + networks + 6 * anchors * cells


def seconds(maps: dict[str, LayerMaps], config: TrainConfig, tracked_views: int = 0) -> float:
    """Time of a whole run; `tracked_views`: frames that garments are followed through, times cameras."""
    gaussians = sum(len(layer) for layer in maps.values())
    pictures = config.views_per_step * (gaussians * _SECONDS_PER_GAUSSIAN_SEEN + _SECONDS_PER_PICTURE)
    networks = gaussians * _SECONDS_PER_GAUSSIAN
    if config.model.decoder == "blendshapes":
        networks += gaussians * _basis_numbers(config.model) * _SECONDS_PER_BASIS_NUMBER
    for layer in maps.values():
        grid = network_grid(layer.window, config.model.factor, config.model.depth)
        work = sum(network_parameters(layer, config.model)) * grid.height * grid.width
        networks += len(config.model.networks_of(layer.layer)) * _SECONDS_PER_NETWORK
        networks += work * _SECONDS_PER_WEIGHT_PIXEL
    perceived = 2 * config.views_per_step * perceived_pixels(config) * _SECONDS_PER_PERCEIVED_PIXEL
    total = config.steps * (pictures + networks + perceived)
    if config.track.frame_step and config.model.anchors:
        total += tracked_views * _SECONDS_PER_TRACKED_VIEW + config.track.warm_up * pictures
    return min(total, 60.0 * config.minutes) if config.minutes > 0 else total


def affordable_tracking(config: TrainConfig, frames: int, cameras: int) -> TrainConfig:
    """The configuration with every so many-th frame followed that `minutes` leave time for.

    Tracking is expected to take no more than a third of the run; else only frames that are learned from are
    followed, or every second of them, and so on. Decided from numbers, not from the clock: a run can be
    repeated.
    """
    step = config.track.frame_step
    if config.minutes <= 0 or not step:
        return config
    most = _TRACKING_SHARE * 60.0 * config.minutes / (cameras * _SECONDS_PER_TRACKED_VIEW)
    wider = [
        config.frame_step * factor for factor in range(1, frames + 1) if config.frame_step * factor > step
    ]
    step = next((s for s in (step, *wider) if math.ceil(frames / s) <= most), 0)
    return replace(config, track=replace(config.track, frame_step=step))


def disk_bytes(learned: int) -> int:
    """Weights, the checkpoint with moments (while it runs), metrics and previews; of so many numbers."""
    return 4 * _FLOAT * learned + (16 << 20)


def perceived_pixels(config: TrainConfig) -> int:
    """Of one crop that LPIPS sees; 0 without perceptual weights."""
    return config.perceptual_side**2 if config.perceptual_digest else 0


def _basis_numbers(model: ModelConfig) -> int:
    """Learned numbers of a texel's blendshapes."""
    return sum(width * rank for width, rank in zip((3, 3, 8), model.ranks, strict=True))


def _anchor_cells(layer: LayerMaps, model: ModelConfig) -> int:
    """Of a side of the maps of an anchor."""
    grid = network_grid(layer.window, model.factor, model.depth)
    height, width = (math.ceil(side * model.factor / model.anchor_cell) for side in (grid.height, grid.width))
    return height * width


def network_parameters(layer: LayerMaps, model: ModelConfig) -> list[int]:
    """Of every network of a layer, and of what shows it the view."""
    grid = network_grid(layer.window, model.factor, model.depth)
    inputs = 3 if model.input_views == "front" else 6
    outputs = model.networks_of(layer.layer)
    with torch.device("meta"):
        networks: list[torch.nn.Module] = [
            StyleUNet(inputs, count, (grid.height, grid.width), model.depth, model.width, model.style)
            for count in outputs
        ]
        if outputs and model.view_conditioning:
            networks.append(ViewNet(model.width))
    return [sum(p.numel() for p in network.parameters()) for network in networks]

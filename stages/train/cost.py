"""What a run will cost, before it starts; estimates for two CPU cores."""

from __future__ import annotations

import math
from dataclasses import replace

from stages.shared.avatar.decoders.base import DecoderCost
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.avatar.maps import LayerMaps
from stages.train.config import TrainConfig

# Measured on two cores, forward and backward: per Gaussian and camera and per camera (512² images), per
# Gaussian (deformation and surface terms).
_SECONDS_PER_GAUSSIAN_SEEN = 0.6e-6
_SECONDS_PER_PICTURE = 0.02
_SECONDS_PER_GAUSSIAN = 1.5e-6
_SECONDS_PER_TRACKED_VIEW = 0.15  # a frame in one camera, all rounds
# Reckoned, not measured: VGG-16 there, back, and once for the truth at 100 GFLOP/s.
_SECONDS_PER_PERCEIVED_PIXEL = 1.8e-5
_TRACKING_SHARE = 1 / 3
_FLOAT = 4


def decoder_costs(
    maps: dict[str, LayerMaps], config: TrainConfig, key_poses: int = 0
) -> dict[str, DecoderCost]:
    """Cost of every layer's decoder with so many key poses, where the settings have any."""
    model = replace(config.model, anchors=key_poses if config.model.anchors else 0)
    decoder = decoder_class(model.decoder)
    return {name: decoder.cost(layer, model) for name, layer in maps.items()}


def parameters(maps: dict[str, LayerMaps], config: TrainConfig, key_poses: int = 0) -> int:
    """Learned numbers of all layers."""
    return sum(cost.parameters for cost in decoder_costs(maps, config, key_poses).values())


def seconds(maps: dict[str, LayerMaps], config: TrainConfig, tracked_views: int = 0) -> float:
    """Time of a whole run; `tracked_views`: frames that garments are followed through, times cameras."""
    gaussians = sum(len(layer) for layer in maps.values())
    pictures = config.views_per_step * (gaussians * _SECONDS_PER_GAUSSIAN_SEEN + _SECONDS_PER_PICTURE)
    networks = gaussians * _SECONDS_PER_GAUSSIAN
    networks += sum(cost.seconds for cost in decoder_costs(maps, config).values())
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

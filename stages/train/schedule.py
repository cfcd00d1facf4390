"""Optimiser and schedule: Adam, and what changes in the course of a run.

The functions of the schedule take the progress of the run, 0 at the start and 1 at the end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, replace

import torch

from stages.shared.avatar.decoders.base import Decoder
from stages.train.config import LossWeights, TrainConfig

_COARSE_STEPS = 3
_ADAM_EPSILON = 1e-15  # gradients of single Gaussians are tiny; the usual 1e-8 would drown them


def progress(config: TrainConfig, step: int, elapsed: float) -> float:
    """How far the run is, 0..1: by steps, or by the clock (`elapsed` s) when that is nearer to its end."""
    done = step / max(config.steps, 1)
    if config.minutes > 0:
        done = max(done, elapsed / (60.0 * config.minutes))
    return min(done, 1.0)


def rate_factor(config: TrainConfig, done: float) -> float:
    """Cosine from 1 to `rate_end`."""
    return config.rate_end + (1.0 - config.rate_end) * 0.5 * (1.0 + math.cos(math.pi * done))


def is_coarse(config: TrainConfig, done: float) -> bool:
    """Whether the run is still at small pictures, where nothing but positions is learned.

    Gaussians that could change size or colour then would fit the blur instead of moving. A tracked run needs
    none of it: its geometry is near from the start.
    """
    return config.track.frame_step == 0 and done < config.coarse_until


def image_scale(config: TrainConfig, done: float) -> float:
    """Size of the pictures: from coarse to full by equal ratios, in a few steps within `coarse_until`."""
    if not is_coarse(config, done):
        return config.image_scale
    share = math.floor(_COARSE_STEPS * done / config.coarse_until) / _COARSE_STEPS
    return config.image_scale * config.coarse_scale ** (1.0 - share)


def stage_weights(config: TrainConfig, done: float) -> LossWeights:
    """The weights in force.

    The first stage knows neither penetration nor smoothing nor the face's LPIPS (Gaussian Wardrobe,
    sec. 3.4); flow guides the early part only, and not where garments were tracked.
    """
    weights = config.weights
    if done < config.stage_two:
        weights = replace(weights, penetration=0.0, smooth=0.0, face=0.0)
    if done >= config.flow_until or config.track.frame_step:
        weights = replace(weights, flow=0.0)
    return weights


def named_parameters(models: dict[str, Decoder]) -> Iterator[tuple[str, torch.nn.Parameter]]:
    """What is learned, as layer.name; frozen parameters are left out."""
    for layer, model in models.items():
        for name, parameter in model.named_parameters():
            if parameter.requires_grad:
                yield f"{layer}.{name}", parameter


def adam(config: TrainConfig, models: dict[str, Decoder]) -> torch.optim.Adam:
    """Adam with one group per kind of parameter."""
    step_sizes = asdict(config.rates)
    groups: dict[tuple[str, float], list[torch.nn.Parameter]] = {}
    for model in models.values():
        for kind, (step_size, parameters) in model.parameter_groups(step_sizes).items():
            groups.setdefault((kind, step_size), []).extend(parameters)
    return torch.optim.Adam(
        [
            {"params": parameters, "kind": kind, "lr": step_size, "start_rate": step_size}
            for (kind, step_size), parameters in groups.items()
        ],
        eps=_ADAM_EPSILON,
        fused=True,
    )

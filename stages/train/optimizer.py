"""Adam, with one group per kind of parameter and step sizes in the units of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

import torch

from stages.shared.avatar.decoders.base import Decoder
from stages.train.config import TrainConfig

_ADAM_EPSILON = 1e-15  # gradients of single Gaussians are tiny; the usual 1e-8 would drown them


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

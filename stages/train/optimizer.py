"""Adam, with one group per kind of parameter and step sizes in the units of each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict

import torch

from stages.shared.avatar.blendshapes import GROUPS
from stages.shared.avatar.decoder import AvatarModel
from stages.train.config import TrainConfig

_ADAM_EPSILON = 1e-15  # gradients of single Gaussians are tiny; the usual 1e-8 would drown them


def named_parameters(models: dict[str, AvatarModel]) -> Iterator[tuple[str, torch.nn.Parameter]]:
    """What is learned, as layer.name; frozen parameters are left out."""
    for layer, model in models.items():
        for name, parameter in model.named_parameters():
            if parameter.requires_grad:
                yield f"{layer}.{name}", parameter


def adam(config: TrainConfig, models: dict[str, AvatarModel]) -> torch.optim.Adam:
    """Adam with one group per kind of parameter."""
    groups: dict[str, list[torch.nn.Parameter]] = {}
    rates = {**asdict(config.rates), **_basis_rates(config)}
    for name, parameter in named_parameters(models):
        kind = name.split(".")[1]  # base_<attribute>, basis_<group>, anchors, or a part of the networks
        kind = kind.removeprefix("base_") if kind.startswith("base_") else kind
        kind = kind if kind in rates else "network"
        groups.setdefault(kind, []).append(parameter)
    return torch.optim.Adam(
        [
            {
                "params": members,
                "kind": kind,
                "lr": rates[kind],
                "start_rate": rates[kind],
            }
            for kind, members in groups.items()
        ],
        eps=_ADAM_EPSILON,
        fused=True,
    )


def _basis_rates(config: TrainConfig) -> dict[str, float]:
    """Step sizes of blendshapes: K bases of unit coefficients together move as fast as the attribute alone.

    In units of the residual. A group of several attributes takes the slowest one's.
    """
    rates, model = config.rates, config.model
    per_unit = {"offset": rates.offset / model.offset_scale, "color": rates.color}
    per_unit["form"] = min(rates.quaternion, rates.opacity, rates.scale)
    ranks = zip(GROUPS, model.ranks, strict=True)
    return {f"basis_{group}": per_unit[group] / math.sqrt(max(rank, 1)) for group, rank in ranks}

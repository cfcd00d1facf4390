"""Joins layers to one set of Gaussians whose features are colours and one-hot layer labels."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from stages.shared.avatar.deform import PosedGaussians
from stages.shared.splat.gaussians import Gaussians


def compose(posed: dict[str, PosedGaussians]) -> Gaussians:
    """Concatenate layers given inner to outer (name -> Gaussians)."""
    layers = tuple(posed)
    counts = [len(gaussians.means) for gaussians in posed.values()]
    device = next(iter(posed.values())).means.device
    layer_ids = torch.repeat_interleave(
        torch.arange(len(layers), device=device), torch.tensor(counts, device=device)
    )
    colors = torch.cat([gaussians.colors for gaussians in posed.values()])
    labels = functional.one_hot(layer_ids, len(layers)).to(colors.dtype)
    return Gaussians(
        means=torch.cat([gaussians.means for gaussians in posed.values()]),
        covariances=torch.cat([gaussians.covariances for gaussians in posed.values()]),
        opacities=torch.cat([gaussians.opacities for gaussians in posed.values()]),
        features=torch.cat((colors, labels), dim=1),
        layer_ids=layer_ids,
        layers=layers,
    )


def relabelled(composite: Gaussians, layer_ids: Tensor, layers: tuple[str, ...]) -> Gaussians:
    """The same Gaussians under other layers: those that their texels show, of a model with fewer layers.

    `layer_ids` (N,) are indices into `layers`; layers that no Gaussian shows are left out.
    """
    shown = torch.unique(layer_ids)
    ids = torch.searchsorted(shown, layer_ids)
    labels = functional.one_hot(ids, len(shown)).to(composite.features)
    return replace(
        composite,
        features=torch.cat((composite.features[:, :3], labels), dim=1),
        layer_ids=ids,
        layers=tuple(layers[index] for index in shown.tolist()),
    )

"""Texels of several layers as one layer: what the baselines are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.texel_maps import neighbour_texels, texel_numbers

_POKES_THROUGH = 0.01  # m: a fitted body that is in front of cloth by less than this lies under it
_LARGEST_STEP = 0.03  # m in depth between neighbouring texels


def outermost(layers: Sequence[LayerMaps]) -> Tensor:
    """Indices into the concatenated texels of all layers: the outermost at each pixel of each view, in pixel
    order.
    """
    pixels = torch.cat([layer.pixel_ids() for layer in layers])
    view = torch.cat([layer.texels[:, 0] for layer in layers])
    height = torch.cat([layer.positions[:, 2] + index * _POKES_THROUGH for index, layer in enumerate(layers)])
    back = torch.cat([-layer.positions[:, 2] + index * _POKES_THROUGH for index, layer in enumerate(layers)])
    order = torch.argsort(torch.where(view == 0, height, back), descending=True, stable=True)
    order = order[view[order] < 2]  # further sheets of a layer lie inside it
    order = order[torch.argsort(pixels[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool)
    first[1:] = pixels[order][1:] != pixels[order][:-1]
    return order[first]


def concatenate(layers: Sequence[LayerMaps], name: str) -> LayerMaps:
    """The texels of all layers one after the other, in the smallest window that holds them. Links stay."""
    starts = [0]
    for layer in layers:
        starts.append(starts[-1] + len(layer))
    values: dict[str, Any] = {}
    for field in _per_texel(layers[0]):
        values[field] = torch.cat([getattr(layer, field) for layer in layers])
    values["neighbours"] = torch.cat(
        [
            torch.where(layer.neighbours >= 0, layer.neighbours + start, -1)
            for layer, start in zip(layers, starts, strict=False)
        ]
    )
    values["seams"] = torch.cat([layer.seams + start for layer, start in zip(layers, starts, strict=False)])
    return replace(layers[0], layer=name, window=_window(values["texels"]), **values)


def select(maps: LayerMaps, chosen: Tensor) -> LayerMaps:
    """The texels `chosen` (K,), with the links between them."""
    number = torch.full((len(maps) + 1,), -1)  # the last entry means "none"
    number[chosen] = torch.arange(len(chosen))
    seams = number[maps.seams]
    values: dict[str, Any] = {field: getattr(maps, field)[chosen] for field in _per_texel(maps)}
    values["neighbours"] = number[maps.neighbours[chosen]]
    values["seams"] = seams[(seams >= 0).all(dim=1)]
    return replace(maps, window=_window(values["texels"]), **values)


def neighbours_across_layers(maps: LayerMaps) -> Tensor:
    """(N, 4) texel above, right, below, left in the same view; −1 for none, or across a step in depth."""
    texels, jump = maps.texels.numpy(), max(_LARGEST_STEP, 3 * maps.pitch)
    numbers = texel_numbers(texels, maps.window, maps.views)
    neighbours = neighbour_texels(numbers, texels, maps.window, maps.positions[:, 2].numpy(), jump)
    return torch.from_numpy(neighbours.astype(np.int64))


def _window(texels: Tensor) -> tuple[int, int, int, int]:
    low, high = texels[:, 1:].min(dim=0).values, texels[:, 1:].max(dim=0).values
    row, column, last_row, last_column = (int(value) for value in torch.cat((low, high)))
    return row, column, last_row - row + 1, last_column - column + 1


def _per_texel(maps: LayerMaps) -> list[str]:
    """Names of the tensors with a row per texel that mean the same in any selection."""
    linked = ("neighbours", "seams")
    names = [
        f.name for f in fields(maps) if isinstance(getattr(maps, f.name), Tensor) and f.name not in linked
    ]
    return [name for name in names if len(getattr(maps, name)) == len(maps)]

"""Random weights in the layout of a perceptual weight file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from stages.shared.losses.perceptual import BLOCKS

Blocks = Sequence[Sequence[tuple[int, int, int]]]


def random_weights(blocks: Blocks = BLOCKS) -> dict[str, torch.Tensor]:
    """Convolutions that keep the size of their input; heads that are not negative."""
    generator = torch.Generator().manual_seed(0)
    weights = {}
    for layer, block in enumerate(blocks):
        for index, inputs, outputs in block:
            kernel = torch.randn(outputs, inputs, 3, 3, generator=generator)
            weights[f"features.{index}.weight"] = kernel * math.sqrt(2 / (9 * inputs))
            weights[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        weights[f"lin{layer}.model.1.weight"] = torch.rand(1, block[-1][2], 1, 1, generator=generator)
    return weights

"""Skin that no image ever shows takes the colour of the skin that is seen."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.shared.finite import finite


def covered_skin_loss(colors: Tensor, covered: Tensor, reference: Tensor) -> Tensor:
    """Mean of |colour − median colour of the reference texels| over covered texels.

    Arguments:
        colors: (N, 3) of the body layer. covered, reference: (N,) bool; either empty gives 0. The reference
            colour is held fixed.
    """
    if not bool(covered.any()) or not bool(reference.any()):
        return colors.sum() * 0.0
    skin = colors[reference].detach().median(dim=0).values
    return finite((colors[covered] - skin).abs().mean(), "covered_skin_loss", colors=colors)


def hand_texels(skin_weights: Tensor) -> Tensor:
    """(N,) bool: texels that follow a wrist or finger joint most; weights (N, 55)."""
    joint = skin_weights.argmax(dim=1)
    return (joint == 20) | (joint == 21) | (joint >= 25) if len(joint) else torch.zeros(0, dtype=torch.bool)

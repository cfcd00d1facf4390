"""Gaussians as leaves of a graph of their own: pictures are differentiated one after the other, and what
comes before the Gaussians once.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from stages.shared.avatar.compose import Composite

_NAMES = ("means", "covariances", "opacities", "features")


def detached(composite: Composite) -> Composite:
    """The same Gaussians as leaves of a new graph."""
    leaves = {name: getattr(composite, name).detach().requires_grad_() for name in _NAMES}
    return replace(composite, **leaves)


def roots(composite: Composite, leaves: Composite) -> list[tuple[Tensor, Tensor | None]]:
    """Where differentiation goes on: the composite's tensors, each with what its leaf was given."""
    pairs = [(getattr(composite, name), getattr(leaves, name).grad) for name in _NAMES]
    return [(root, seed) for root, seed in pairs if root.requires_grad]


def take_gradients(leaves: Composite) -> Tensor:
    """The leaves' gradients in a row (M,), taken away from them; zeros where there are none."""
    tensors = [getattr(leaves, name) for name in _NAMES]
    found = [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in tensors]
    for leaf in tensors:
        leaf.grad = None
    return torch.cat([gradient.flatten() for gradient in found])


def give_gradients(leaves: Composite, gradients: Tensor) -> None:
    """Put gradients (M,) back in the order of `take_gradients`."""
    tensors = [getattr(leaves, name) for name in _NAMES]
    for leaf, part in zip(tensors, gradients.split([leaf.numel() for leaf in tensors]), strict=True):
        leaf.grad = part.view_as(leaf)

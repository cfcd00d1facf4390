"""The boundary between two graphs: from parameters to Gaussians, and from Gaussians to pictures.

Pictures are differentiated one after the other, up to the Gaussians. What comes before the Gaussians is
differentiated once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from stages.shared.avatar.decoders.base import Decoder
from stages.shared.splat.gaussians import Gaussians

_NAMES = ("means", "covariances", "opacities", "features")


def detach(composite: Gaussians) -> Gaussians:
    """The same Gaussians as inputs of a new graph."""
    inputs = {name: getattr(composite, name).detach().requires_grad_() for name in _NAMES}
    return replace(composite, **inputs)


def upstream_gradients(
    composite: Gaussians, detached: Gaussians, observed: Tensor | None = None
) -> list[tuple[Tensor, Tensor | None]]:
    """The composite's tensors, each with the gradient that its detached copy accumulated, where there is one.

    Arguments:
        observed: (N,) 0..1, factor of every Gaussian's gradients; None for 1.
    """
    pairs: list[tuple[Tensor, Tensor | None]] = []
    for name in _NAMES:
        output, gradient = getattr(composite, name), getattr(detached, name).grad
        if not output.requires_grad or gradient is None:
            continue
        if observed is not None:
            gradient = gradient * _like_rows(observed, gradient)
        pairs.append((output, gradient))
    return pairs


def take_gradients(detached: Gaussians) -> Tensor:
    """The accumulated gradients as one row (M,), zeros where there are none; they are reset."""
    tensors = [getattr(detached, name) for name in _NAMES]
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in tensors]
    for tensor in tensors:
        tensor.grad = None
    return torch.cat([gradient.flatten() for gradient in gradients])


def give_gradients(detached: Gaussians, gradients: Tensor) -> None:
    """Put gradients (M,) back, in the order of `take_gradients`."""
    tensors = [getattr(detached, name) for name in _NAMES]
    for tensor, part in zip(tensors, gradients.split([t.numel() for t in tensors]), strict=True):
        tensor.grad = part.view_as(tensor)


def observed_of(decoders: Iterable[Decoder]) -> Tensor | None:
    """(N,) `Decoder.observed` of all layers in order; None where every texel is observed."""
    decoders = list(decoders)
    if all(decoder.all_observed for decoder in decoders):
        return None
    return torch.cat([decoder.observed for decoder in decoders])


def mask_gradients(composite: Gaussians, observed: Tensor | None) -> None:
    """Multiply gradients that will reach the composite by `observed` (N,); None changes nothing."""
    if observed is None:
        return
    for name in _NAMES:
        tensor = getattr(composite, name)
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: gradient * _like_rows(observed, gradient))


def _like_rows(factors: Tensor, rows: Tensor) -> Tensor:
    """Factors (N,) in a shape that multiplies rows (N, …)."""
    return factors.view(-1, *[1] * (rows.ndim - 1))

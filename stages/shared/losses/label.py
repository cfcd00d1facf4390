"""Rendered one-hot layer labels against the segmentation of the image."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite


def label_loss(labels: Tensor, truth: Tensor, known: Tensor, kind: str = "l1") -> Tensor:
    """Mean difference over known pixels and channels.

    Arguments:
        labels: (H, W, L) rendered one-hot channels, background 0. truth: (H, W, L) 0 or 1.
        known: (H, W) weight, 0 where the segmentation says nothing. kind: "l1" or "l2" (squared).
    """
    difference = labels - truth
    cost = difference.abs() if kind == "l1" else difference.square()
    mean = (cost.sum(dim=2) * known).sum() / (known.sum().clamp(min=1.0) * max(labels.shape[2], 1))
    return finite(mean, "label_loss", labels=labels, truth=truth, known=known)

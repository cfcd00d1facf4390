"""Outer layers stay outside inner ones: max(ε − (p − p̄)·n̄, 0)² (Gaussian Wardrobe, sec. 3.4).

p̄ is the nearest posed Gaussian of the inner layer and n̄ its estimated normal; both are held fixed, so that
the garment gives way and not the body. The mean runs over all outer points: no violation gives 0.
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.finite import finite, require_finite


def nearest_inner(outer: Tensor, inner: Tensor) -> Tensor:
    """Index (N,) int64 of the inner point (M, 3) nearest to each outer point (N, 3); M must not be 0."""
    tree = cKDTree(inner.detach().cpu().numpy(), balanced_tree=False, compact_nodes=False)
    _, nearest = tree.query(outer.detach().cpu().numpy())
    return torch.from_numpy(nearest).to(outer.device)


def penetration_loss(
    outer: Tensor,
    inner: Tensor,
    inner_normals: Tensor,
    margin: float = 0.005,
    reach: float = 0.1,
    every: int = 1,
    phase: int = 0,
) -> Tensor:
    """Mean hinge over the outer points, or over every so many-th of them.

    Arguments:
        outer: (N, 3) m. inner: (M, 3) m. inner_normals: (M, 3) unit, zero where unknown.
        margin: ε, m. reach: m, inner points farther away than this belong to another limb and do not count.
        every, phase: only points phase % every, then each `every`-th, are looked up; their mean stands for
            all, and phases take turns.
    """
    outer = outer[phase % every :: every]
    if len(outer) == 0 or len(inner) == 0:
        return outer.sum() * 0.0
    require_finite("penetration_loss", outer=outer, inner=inner, inner_normals=inner_normals)
    nearest = nearest_inner(outer, inner)
    anchor, normal = inner.detach()[nearest], inner_normals.detach()[nearest]
    away = outer - anchor
    height = (away * normal).sum(dim=1)
    counts = (away.detach().norm(dim=1) < reach) & (normal.square().sum(dim=1) > 0.25)
    cost = ((margin - height).clamp(min=0.0).square() * counts).mean()
    return finite(cost, "penetration_loss", outer=outer, inner=inner, inner_normals=inner_normals)

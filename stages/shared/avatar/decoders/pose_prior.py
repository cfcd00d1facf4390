"""Poses unlike all training poses: what the networks see of them, and how much of the mean residual is used.

Positional maps of the training poses span a few directions (PCA). A map outside their distribution is
replaced by its projection on these directions, no farther than σ standard deviations along each (Animatable
Gaussians, pose projection). The bones still move in the true pose. Poses inside the distribution
(Mahalanobis distance up to nearly the largest of training) are left as they are.

The mean residual of the training is the best constant guess for the same take. For other motions it
overstates. The share of it is chosen by leaving out quarters of the take, in order of time, and measuring
how far the mean of the rest is from them (shrinkage by blocked cross-validation). Neighbouring frames are
too alike for leaving out single ones.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from stages.shared.finite import require_finite

_LEAST_SHARE = 0.01  # of the first direction's deviation; weaker ones are noise and would rule the distance
_WITHIN = 0.99  # share of training poses that count as inside
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_PARTS = 4


class PosePrior(nn.Module):
    """PCA of K training maps in at most `count` directions; does nothing until `fit`.

    Arguments:
        count: k. size: M values of a map. sigma: standard deviations that a pose may depart by.
    """

    mean: Tensor  # (M,)
    directions: Tensor  # (k, M), orthonormal; unused ones are zero
    deviations: Tensor  # (k,) standard deviation along each, 0 for unused ones
    limit: Tensor  # (1,) Mahalanobis distance up to which a pose is inside; 0 before `fit`

    def __init__(self, count: int, size: int, sigma: float) -> None:
        super().__init__()
        self.sigma = sigma
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("directions", torch.zeros(count, size))
        self.register_buffer("deviations", torch.zeros(count))
        self.register_buffer("limit", torch.zeros(1))

    @torch.no_grad()
    def fit(self, maps: Tensor) -> None:
        """Learn from the maps (K, M) of the training poses; fewer than three say nothing about a spread."""
        if len(maps) < 3:
            return
        mean = maps.double().mean(dim=0)
        centred = maps.double() - mean
        _, strengths, directions = torch.linalg.svd(centred, full_matrices=False)
        deviations = strengths / (len(maps) - 1) ** 0.5
        kept = int((deviations > _LEAST_SHARE * deviations[0]).sum()) if deviations[0] > 1e-9 else 0
        kept = min(kept, len(self.deviations))
        self.mean.copy_(mean)
        self.directions.zero_()
        self.deviations.zero_()
        self.directions[:kept].copy_(directions[:kept])
        self.deviations[:kept].copy_(deviations[:kept])
        if kept:
            distances = torch.stack([self.distance(one) for one in maps])
            self.limit.copy_(torch.quantile(distances, _WITHIN).clamp(min=1e-6))

    def distance(self, values: Tensor) -> Tensor:
        """() Mahalanobis distance of a map (M,) from the mean, along the kept directions."""
        used = self.deviations > 0
        steps = (self.directions @ (values - self.mean))[used] / self.deviations[used]
        return torch.linalg.vector_norm(steps)

    def outside(self, values: Tensor) -> bool:
        """Whether a map (M,) is outside the distribution of the training poses."""
        return bool(self.limit > 0) and bool(self.distance(values) > self.limit)

    def forward(self, values: Tensor) -> Tensor:
        """A map (M,), or its projection where it is outside."""
        require_finite("PosePrior", values=values)
        if not self.outside(values):
            return values
        reach = self.sigma * self.deviations
        steps = self.directions @ (values - self.mean)
        return self.mean + torch.minimum(torch.maximum(steps, -reach), reach) @ self.directions


def shrunken_mean(residual: Callable[[int], Tensor], count: int) -> tuple[Tensor, float]:
    """The mean (N, 14) of the residuals of `count` ≥ 1 poses in order of time, its offsets shrunk; the share.

    `residual(i)` (N, 14) is asked for twice, so that memory holds five of them whatever the count. Offsets
    are the first three channels; the others keep their mean. With fewer than four poses nothing is left out
    and the share is 1.
    """
    first = residual(0)
    parts = min(_PARTS, count)
    part_of = [index * parts // count for index in range(count)]
    sums = first.new_zeros(parts, *first.shape)
    for index, part in enumerate(part_of):
        sums[part] += residual(index)
    total = sums.sum(dim=0)
    mean = total / count
    share = 1.0
    if count >= _PARTS:
        errors = torch.zeros(len(_SHARES), dtype=torch.float64)
        for index, part in enumerate(part_of):
            left = count - part_of.count(part)
            rest = (total - sums[part])[:, :3] / left
            own = residual(index)[:, :3]
            for choice, candidate in enumerate(_SHARES):
                errors[choice] += (own - candidate * rest).norm(dim=1).mean().double()
        share = _SHARES[int(errors.argmin())]
    return torch.cat((share * mean[:, :3], mean[:, 3:]), dim=1), share

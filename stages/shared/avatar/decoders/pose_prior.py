"""What the networks see of a pose unlike all training poses: the nearest one that the training explains.

Positional maps of the training poses span a few directions (PCA). A map outside their distribution is
replaced by its projection on these directions, no farther than σ standard deviations along each (Animatable
Gaussians, pose projection). The bones still move in the true pose; only what the networks answer is kept to
the known. Poses inside the distribution (Mahalanobis distance up to nearly the largest of training) are left
as they are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from stages.shared.finite import require_finite

_LEAST_SHARE = 0.01  # of the first direction's deviation; weaker ones are noise and would rule the distance
_WITHIN = 0.99  # share of training poses that count as inside


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

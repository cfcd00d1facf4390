"""What a layer does in poses unlike all that it was trained in: how much of the training's mean to trust.

Cloth hung on average somewhere in the take, and that mean is the best constant guess for the same take. For
other motions it overstates: a share of it is right more often. The share is chosen by leaving out quarters
of the take, in order of time, and asking how far the mean of the rest is from them (shrinkage by blocked
cross-validation; neighbouring frames are too alike for leaving out single ones).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_PARTS = 4


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

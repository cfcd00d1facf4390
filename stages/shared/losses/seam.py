"""Front and back maps agree where they meet at the silhouette."""

from __future__ import annotations

from torch import Tensor

from stages.shared.finite import finite

_MM2 = 1e6


def seam_loss(offsets: Tensor, colors: Tensor, seams: Tensor) -> Tensor:
    """Mean over seam pairs of ‖difference of Δp‖² in mm² plus ‖difference of colour‖².

    Arguments:
        offsets: (N, 3) m. colors: (N, 3). seams: (S, 2) int64 texel pairs; no pairs give 0.
    """
    if len(seams) == 0:
        return (offsets.sum() + colors.sum()) * 0.0
    first, second = seams.unbind(dim=1)
    apart = (offsets[first] - offsets[second]).square().sum(dim=1) * _MM2
    cost = (apart + (colors[first] - colors[second]).square().sum(dim=1)).mean()
    return finite(cost, "seam_loss", offsets=offsets, colors=colors)

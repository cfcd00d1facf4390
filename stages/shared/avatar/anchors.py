"""Free offsets of the poses a layer was trained in, blended for poses in between.

A network that sees one frame per step needs very long to learn where cloth hung in each of them. Here every
anchor pose has a coarse map of offsets of its own, and a pose takes the maps of the anchors it resembles, by
a Gaussian kernel. Poses are compared by the layer's own positional map, and a little by the rotations of all
joints: a skirt hangs otherwise when the arms swing, though the legs stand alike. Far from every anchor the
offsets fade, and the base attributes remain.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.shared.finite import require_finite

_BANDWIDTH = 0.5  # kernel width in units of the usual distance between neighbouring anchors
_NARROWEST = 0.1  # in units of the usual distance
_LEAST = 1e-3
_FLOOR = 0.05  # weight of "no anchor": what makes offsets fade far from all


class AnchorOffsets(nn.Module):
    """Offset maps of K anchor poses.

    Arguments:
        count: K. size: (height, width) of the coarse maps. features: length of a pose's description.
        own_widths: a kernel width for every anchor, by the distance to its nearest neighbour.
    """

    poses: Tensor  # (K, M) descriptions of the anchor poses
    bandwidth: Tensor  # (1,), or (K,) with own widths

    def __init__(self, count: int, size: tuple[int, int], features: int, own_widths: bool = False) -> None:
        super().__init__()
        self.offsets = nn.Parameter(torch.zeros(count, 6, *size))  # m; front x y z, back x y z
        self.register_buffer("poses", torch.zeros(count, features))
        self.register_buffer("bandwidth", torch.ones(count if own_widths else 1))

    def fit(self, poses: Tensor) -> Tensor:
        """Choose anchors among training poses (T, M), T ≥ K: the first, then always the farthest from all.

        With T = K every pose is an anchor, in order, also where two are alike. Returns which (K,).
        """
        # The exact form: the quick one loses near poses in rounding and would take one of them twice.
        distance = torch.cdist(poses, poses, compute_mode="donot_use_mm_for_euclid_dist")
        every = len(poses) == len(self.poses)
        chosen = torch.arange(len(poses)) if every else spread_out(distance, len(self.poses))
        self.poses.copy_(poses[chosen])
        between = distance[chosen][:, chosen] + torch.diag(torch.full((len(chosen),), float("inf")))
        nearest = between.min(dim=1).values if len(chosen) > 1 else torch.ones(1)
        usual = nearest.median()
        widths = nearest.clamp(min=_NARROWEST * float(usual)) if len(self.bandwidth) > 1 else usual
        self.bandwidth.copy_((_BANDWIDTH * widths).clamp(min=1e-6))
        return chosen

    def weights(self, pose: Tensor) -> Tensor:
        """Share (K,) of every anchor in a pose (M,); they sum to less than 1 far from all anchors."""
        kernel = self._kernel(pose)
        return kernel / (kernel.sum() + _FLOOR)

    def familiarity(self, pose: Tensor) -> Tensor:
        """How much a pose (M,) is like the anchors: () 1 at an anchor or between two, 0 far from all."""
        return self._kernel(pose).sum().clamp(max=1.0)

    def _kernel(self, pose: Tensor) -> Tensor:
        require_finite("AnchorOffsets", pose=pose)
        squared = (self.poses - pose).square().sum(dim=1) / (2 * self.bandwidth.square())
        kernel = torch.exp(-squared) - _LEAST
        kernel = kernel.clamp(min=0.0)  # exactly none, so that Adam does not enlarge traces of other poses
        return kernel / (1.0 - _LEAST)

    def forward(self, pose: Tensor) -> Tensor:
        """Offset maps (2, 3, height, width) m of a pose (M,)."""
        count, channels, height, width = self.offsets.shape
        blend = self.weights(pose) @ self.offsets.reshape(count, -1)
        return blend.view(2, channels // 2, height, width)


def spread_out(distance: Tensor, count: int) -> Tensor:
    """(count,) sorted indices of poses far from one another: the first, then always the farthest from all.

    `distance` (T, T): between all of them.
    """
    chosen = [0]
    nearest = distance[0].clone()
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = torch.minimum(nearest, distance[chosen[-1]])
    return torch.tensor(sorted(chosen))


def sampled_maps(images: Tensor, points: Tensor, view_counts: list[int]) -> Tensor:
    """Maps (2, C, h, w), front and back, at every texel (N, C), bilinear.

    Arguments:
        points: (N, 2) x, y in −1..1 from edge to edge. view_counts: how many of them, in order, belong to
            each view; the sheets of one side share that side's map.
    """
    parts = []
    for view, part in enumerate(points.split(view_counts)):
        if len(part) == 0:
            continue
        found = functional.grid_sample(
            images[view % 2 : view % 2 + 1],
            part[None, None],
            mode="bilinear",
            padding_mode="border",
            align_corners=False,
        )
        parts.append(found[0, :, 0].T)
    return torch.cat(parts) if parts else images.new_zeros(0, images.shape[1])

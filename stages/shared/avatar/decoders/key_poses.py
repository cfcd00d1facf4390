"""Free offsets of key poses, blended for the poses in between.

A network that sees one frame per step learns slowly where cloth hung in each of them. Here every key pose
has a coarse map of offsets of its own. Any other pose takes the maps of the key poses that it resembles, by a
Gaussian kernel. Poses are compared by the layer's own positional map, and with less weight by the rotations
of all joints, because a skirt also depends on the arms. Far from every key pose the offsets fade, and the
base attributes remain.

Stored states and configurations call key poses "anchors".
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.shared.finite import require_finite

_BANDWIDTH = 0.5  # kernel width in units of the usual distance between neighbouring key poses
_NARROWEST = 0.1  # in units of the usual distance
_LEAST = 1e-3
_FLOOR = 0.05  # weight of "no key pose": it makes offsets fade far from all of them


class KeyPoseOffsets(nn.Module):
    """Offset maps of K key poses.

    Arguments:
        count: K. size: (height, width) of the coarse maps. features: length of a pose's description.
        own_widths: a kernel width for every key pose, by the distance to its nearest neighbour.
        points: (N, 2) where the layer's texels lie on the maps, x, y in −1..1 from edge to edge.
        cell: texels per cell of the maps.
    """

    poses: Tensor  # (K, M) descriptions of the key poses
    points: Tensor  # (N, 2)
    bandwidth: Tensor  # (1,), or (K,) with own widths

    def __init__(
        self,
        count: int,
        size: tuple[int, int],
        features: int,
        own_widths: bool = False,
        points: Tensor | None = None,
        cell: int = 1,
    ) -> None:
        super().__init__()
        self.cell = cell
        self.offsets = nn.Parameter(torch.zeros(count, 6, *size))  # m; front x y z, back x y z
        self.register_buffer("poses", torch.zeros(count, features))
        self.register_buffer("bandwidth", torch.ones(count if own_widths else 1))
        self.register_buffer("points", torch.zeros(0, 2) if points is None else points, persistent=False)

    def fit(self, poses: Tensor) -> Tensor:
        """Choose key poses among training poses (T, M), T ≥ K: the first, then always the farthest from all.

        With T = K every pose is a key pose, in order, also where two are alike. Returns which (K,).
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
        """Share (K,) of every key pose in a pose (M,); they sum to less than 1 far from all of them."""
        kernel = self._kernel(pose)
        return kernel / (kernel.sum() + _FLOOR)

    def confidence(self, pose: Tensor) -> Tensor:
        """Confidence () of the kernel in a pose (M,): 1 at a key pose or between two, 0 far from all."""
        return self._kernel(pose).sum().clamp(max=1.0)

    def _kernel(self, pose: Tensor) -> Tensor:
        require_finite("KeyPoseOffsets", pose=pose)
        squared = (self.poses - pose).square().sum(dim=1) / (2 * self.bandwidth.square())
        kernel = torch.exp(-squared) - _LEAST
        kernel = kernel.clamp(min=0.0)  # exactly 0: Adam would enlarge traces of other poses
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

"""What goes into the rasteriser and what comes out: Gaussians, and a rendering of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """The Gaussians of all layers in one world.

    Attributes:
        means: (N, 3) m. covariances: (N, 3, 3) m². opacities: (N,) 0..1.
        features: (N, 3 + L) sRGB, then one channel per layer, 1 for the Gaussian's own layer.
        layer_ids: (N,) int64, index into `layers`.
        layers: L names, inner to outer.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    features: Tensor
    layer_ids: Tensor
    layers: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Rendering:
    """Pictures of one set of Gaussians. A leading camera axis B is there when `viewmats` had one.

    features: ([B,] H, W, C) sum over Gaussians k of w_k c_k, plus T_end times the background.
        w_k = alpha_k T_k; T_k is the transmittance in front of k; T_end what is left at the end.
    alpha: ([B,] H, W) sum of w_k = 1 - T_end, in [0, 1).
    depth: ([B,] H, W) sum of w_k z_k in metres, z_k the camera depth of the centre; not divided by alpha.
    median_depth: ([B,] H, W) depth of the Gaussian that takes the transmittance to 0.5 or below, 0 where
        none does; only with `SplatSettings.median_depth`; carries no gradient.
    layers: the layers that were asked for, each as if the others were not there.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor | None = None
    layers: tuple[Rendering, ...] = ()

    @property
    def color(self) -> Tensor:
        """([B,] H, W, 3) the first three features."""
        return self._parts[0]

    @property
    def labels(self) -> Tensor:
        """([B,] H, W, C - 3) the other features: of `Gaussians`, how much of a pixel each layer has."""
        return self._parts[1]

    @cached_property
    def _parts(self) -> tuple[Tensor, Tensor]:
        # One split, whose backward is one concatenation; slices would each fill and add a whole picture.
        color, labels = self.features.split((3, self.features.shape[-1] - 3), dim=-1)
        return color, labels

    @property
    def expected_depth(self) -> Tensor:
        """([B,] H, W) mean camera depth in metres: depth / alpha, 0 where alpha is 0."""
        covered = self.alpha > 0
        return torch.where(covered, self.depth / torch.where(covered, self.alpha, 1.0), 0.0)


def stacked(rows: list[list[Rendering]], dtype: torch.dtype) -> list[Rendering]:
    """Renderings [1 + A][B] of single cameras -> 1 + A with fields (B, H, W, ...)."""

    def joined(row: list[Rendering]) -> Rendering:
        def field(name: str) -> Tensor:
            return torch.stack([getattr(picture, name) for picture in row]).to(dtype)

        median = field("median_depth") if row[0].median_depth is not None else None
        return Rendering(field("features"), field("alpha"), field("depth"), median)

    return [joined(row) for row in rows]

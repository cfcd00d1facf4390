"""What a renderer returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rendering:
    """Pictures of one set of Gaussians. A leading camera axis B is there when `viewmats` had one.

    features: ([B,] H, W, C) sum over Gaussians k of w_k c_k, plus T_end times the background.
        w_k = alpha_k T_k; T_k is the transmittance in front of k; T_end what is left at the end.
    alpha: ([B,] H, W) sum of w_k = 1 - T_end, in [0, 1).
    depth: ([B,] H, W) sum of w_k z_k in metres, z_k the camera depth of the centre; not divided by alpha.
    median_depth: ([B,] H, W) depth of the Gaussian that takes the transmittance to 0.5 or below, 0 where
        none does; only when asked for; carries no gradient.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor | None = None

    @property
    def expected_depth(self) -> Tensor:
        """([B,] H, W) mean camera depth in metres of what is seen: depth / alpha, 0 where alpha is 0."""
        covered = self.alpha > 0
        return torch.where(covered, self.depth / torch.where(covered, self.alpha, 1.0), 0.0)


@dataclass(frozen=True)
class LayeredRendering:
    """The composite of all layers, and the layers asked for, each as if the others were not there."""

    composite: Rendering
    layers: tuple[Rendering, ...]


def stacked(rows: list[list[Rendering]], dtype: torch.dtype) -> list[Rendering]:
    """Renderings [1 + A][B] of single cameras -> 1 + A with fields (B, H, W, ...)."""

    def joined(row: list[Rendering]) -> Rendering:
        def field(name: str) -> Tensor:
            return torch.stack([getattr(picture, name) for picture in row]).to(dtype)

        median = field("median_depth") if row[0].median_depth is not None else None
        return Rendering(field("features"), field("alpha"), field("depth"), median)

    return [joined(row) for row in rows]

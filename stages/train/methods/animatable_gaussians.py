"""The baseline "animatable-gaussians": the whole clothed person is one layer (Li et al. 2024).

Its shape is not removed, and no loss knows of layers. The layer is the outermost surface of all layers' maps,
which is what rays through the whole template would meet. Kept from this project: wrists turned in the
canonical pose, fingers in the positional map, SSIM and optical flow in the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.layers import LAYERS, WHOLE
from stages.train.config import LossWeights
from stages.train.methods.base import PUBLISHED_OFFSET, Baseline, MethodLayers
from stages.train.methods.merge import concatenate, neighbours_across_layers, outermost, select


class AnimatableGaussians(Baseline):
    """One layer. Its texels keep the layer they come from, so that label pictures can be scored."""

    name = "animatable-gaussians"

    def layers(self, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
        whole, ids = whole_layer(list(maps.values()), betas)
        return MethodLayers({WHOLE: whole}, {WHOLE: ids})

    def weights(self, weights: LossWeights) -> LossWeights:
        return replace(
            weights,
            offset=PUBLISHED_OFFSET,
            label=0.0,
            silhouette=0.0,
            penetration=0.0,
            opacity=0.0,
            covered_skin=0.0,
        )


def whole_layer(layers: Sequence[LayerMaps], betas: Tensor) -> tuple[LayerMaps, Tensor]:
    """One layer of the outermost texels of all, with the subject's shape in it.

    Returns its maps, and (N,) the layer that every texel comes from, as an index into LAYERS.

    Arguments:
        layers: maps on one grid, inner to outer. betas: (10,).
    """
    chosen = outermost(layers)
    maps = select(concatenate(layers, WHOLE), chosen)
    shaped = maps.positions + torch.einsum("b,nbk->nk", betas, maps.shape_directions)
    ids = torch.cat([torch.full((len(layer),), LAYERS.index(layer.layer)) for layer in layers])[chosen]
    maps = replace(
        maps,
        positions=shaped,
        shape_directions=torch.zeros_like(maps.shape_directions),
        neighbours=neighbours_across_layers(maps),
    )
    return maps, ids

"""The baseline "layga": the body, and one layer of clothing (after Lin et al. 2024, who publish no code).

The clothing starts on the body's own surface, with smoothness and collision terms. This is an approximation.
Cloth that hangs free of the body, as a skirt does between the legs, has no texels of its own. There is no
first stage with one layer. The collision term is this project's penetration term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import MissingInput
from stages.shared.layers import BODY, CLOTHING, LAYER_OF_LABEL, LAYERS
from stages.train.config import LossWeights
from stages.train.methods.base import PUBLISHED_OFFSET, Baseline, MethodLayers
from stages.train.methods.merge import outermost, select

_OUT_OF_SKIN = 0.005  # m


class LayGA(Baseline):
    """Body and clothing. The texels of the clothing keep the garment that they show."""

    name = "layga"

    def layers(self, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
        garments = [layer for name, layer in maps.items() if name != BODY]
        if BODY not in maps or not garments:
            raise MissingInput(
                "LayGA needs a body and a garment.", "layers of bake-maps", "Choose another --method."
            )
        clothing, ids = clothing_layer(maps[BODY], garments)
        return MethodLayers({BODY: maps[BODY], CLOTHING: clothing}, {CLOTHING: ids})

    def weights(self, weights: LossWeights) -> LossWeights:
        return replace(weights, offset=PUBLISHED_OFFSET)  # clothing has to leave the skin, by centimetres

    def layer_of_label(self, layers: Sequence[str]) -> dict[int, str]:
        return {label: layer if layer == BODY else CLOTHING for label, layer in LAYER_OF_LABEL.items()}


def clothing_layer(body: LayerMaps, garments: Sequence[LayerMaps]) -> tuple[LayerMaps, Tensor]:
    """The body's texels under garments, as a layer just outside the skin.

    Returns its maps, and (N,) the garment that every texel shows, as an index into LAYERS. Colours and labels
    are those of the outermost garment at the same pixel.
    """
    covered = (body.covered_by(list(garments)) & (body.texels[:, 0] < 2)).nonzero()[:, 0]
    if not len(covered):
        raise MissingInput("No garment lies over the body.", "maps of bake-maps", "Choose another --method.")
    maps = replace(select(body, covered), layer=CLOTHING)
    chosen = outermost(garments)
    shown = torch.cat([layer.pixel_ids() for layer in garments])[chosen]
    place = chosen[torch.searchsorted(shown, maps.pixel_ids())]
    ids = torch.cat([torch.full((len(layer),), LAYERS.index(layer.layer)) for layer in garments])[place]
    return replace(
        maps,
        positions=maps.positions + _OUT_OF_SKIN * maps.normals,
        colors=torch.cat([layer.colors for layer in garments])[place],
        color_confidence=torch.cat([layer.color_confidence for layer in garments])[place],
    ), ids

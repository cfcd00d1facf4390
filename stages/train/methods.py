"""The methods that a run can learn: what each decides about layers, losses and settings.

A method is an object that `METHODS` lists. The trainer, the data and the losses ask it, and know no method by
name. A new method is a class here and an entry there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.layers import BODY, CLOTHING, LAYER_OF_LABEL, LAYERS, WHOLE
from stages.train.config import LossWeights, TrainConfig
from stages.train.merge_layers import concatenate, neighbours_across_layers, outermost, select

PUBLISHED_OFFSET = 0.005
"""Weight of the offset loss in the published baselines."""
_OUT_OF_SKIN = 0.005  # m


@dataclass(frozen=True)
class MethodLayers:
    """The layers that a run learns.

    Attributes:
        maps: name to maps, inner to outer.
        layer_ids: name to (N,) int64 index into LAYERS of every texel, for layers that hold several.
    """

    maps: dict[str, LayerMaps]
    layer_ids: dict[str, Tensor] = field(default_factory=dict)


class Method(ABC):
    """One method.

    Attributes:
        name: as `TrainConfig.method` names it.
        baked_layers: it learns the layers of bake-maps as they are, and so can start from another subject's.
    """

    name: str
    baked_layers: bool = True

    @abstractmethod
    def layers(self, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
        """The layers to learn.

        Arguments:
            maps: baked layers, inner to outer. betas: (10,) shape of the subject.

        Raises:
            MissingInput: a layer that the method needs is not there.
        """

    def resolve(self, config: TrainConfig) -> TrainConfig:
        """The configuration as the method changes it; applying it twice changes nothing more.

        Raises:
            UsageProblem: a setting that the method does not allow.
        """
        return config

    def layer_of_label(self, layers: Sequence[str]) -> dict[int, str]:
        """Label id to the layer, of these, that shows it."""
        return {label: layer for label, layer in LAYER_OF_LABEL.items() if layer in layers}


class Baseline(Method):
    """A published method that always has networks, also in presets that do without them."""

    baked_layers = False

    def resolve(self, config: TrainConfig) -> TrainConfig:
        if config.model.decoder != "styleunet":
            raise UsageProblem(
                f"The baseline {self.name} is made of networks.",
                "options --method and --decoder",
                "Leave one of them out.",
            )
        return replace(
            config, weights=self.weights(config.weights), model=replace(config.model, networks="all")
        )

    @abstractmethod
    def weights(self, weights: LossWeights) -> LossWeights:
        """The weights of the losses that the baseline has."""


class GaussianWardrobe(Method):
    """A layer for the body and one for every garment, as they were baked."""

    name = "gaussian-wardrobe"

    def layers(self, maps: dict[str, LayerMaps], betas: Tensor) -> MethodLayers:
        return MethodLayers(maps)


class AnimatableGaussians(Baseline):
    """The whole clothed person is one layer (Li et al. 2024). No loss knows of layers.

    The subject's shape stays in the layer. The layer is the outermost surface of the maps of all layers. Rays
    through the whole template would meet the same surface. Its texels keep the layer they come from, so that
    label pictures can be scored. Kept from this project: wrists turned in the canonical pose, fingers in the
    positional map, SSIM and optical flow in the loss.
    """

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


class LayGA(Baseline):
    """A body and one layer of clothing (after Lin et al. 2024, who publish no code). An approximation.

    The clothing starts on the body's own surface, with smoothness and collision terms. Cloth that hangs free
    of the body, as a skirt does between the legs, has no texels of its own. There is no first stage with one
    layer. The collision term is this project's penetration term. The texels of the clothing keep the garment
    that they show.
    """

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


METHODS: dict[str, Method] = {
    method.name: method for method in (GaussianWardrobe(), AnimatableGaussians(), LayGA())
}


def method_called(name: str) -> Method:
    """A method by its name.

    Raises UsageProblem for a method that does not exist.
    """
    if name not in METHODS:
        raise UsageProblem(
            f"There is no method {name!r}.", "option --method", "Choose of: " + ", ".join(METHODS) + "."
        )
    return METHODS[name]

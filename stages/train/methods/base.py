"""What a method decides: layers, losses, and which settings it allows.

A method is an object that `registry.py` lists. The trainer, the data and the losses ask it, and know no
method by name. A new method is a module of its own and an entry there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import UsageProblem
from stages.shared.layers import LAYER_OF_LABEL
from stages.train.config import LossWeights, TrainConfig

PUBLISHED_OFFSET = 0.005
"""Weight of the offset loss in the published baselines."""


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

"""Which class models a layer: chosen by `decoder` in its configuration."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from stages.shared.avatar.blendshapes import BlendshapeModel, BlendshapeSizes
from stages.shared.avatar.config import DECODERS, ModelConfig
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.model import LayerModel
from stages.shared.errors import BadData, UsageProblem

AvatarModel = LayerModel | BlendshapeModel


def new_model(maps: LayerMaps, config: ModelConfig, poses: int, seed: int = 0) -> AvatarModel:
    """A layer's model before training. `poses`: number of training poses, centres of the kernel.

    Raises UsageProblem for a decoder that does not exist.
    """
    if config.decoder == "blendshapes":
        offset, color, form = config.ranks
        return BlendshapeModel(maps, config, BlendshapeSizes(offset, color, form, poses))
    if config.decoder != "styleunet":
        raise UsageProblem(
            f"There is no decoder called {config.decoder!r}.",
            "option --decoder",
            "Choose one of: " + ", ".join(DECODERS) + ".",
        )
    return LayerModel(maps, config, seed)


def load_model(config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> AvatarModel:
    """The model that its `config` and `state` describe.

    Raises BadData where they do not fit the maps, or the decoder is unknown.
    """
    config = dict(config)
    if isinstance(config.get("ranks"), list):
        config["ranks"] = tuple(config["ranks"])
    decoder = config.get("decoder", "styleunet")
    if decoder == "blendshapes":
        return BlendshapeModel.from_state(config, maps, tensors)
    if decoder != "styleunet":
        raise BadData(
            f"The decoder {decoder!r} is unknown.",
            f"model of layer {maps.layer}",
            "Use a newer version of gw.",
        )
    return LayerModel.from_state(config, maps, tensors)

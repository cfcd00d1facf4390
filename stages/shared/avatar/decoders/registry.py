"""The decoders by name: `ModelConfig.decoder` chooses one."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.blendshapes import BlendshapeDecoder
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData, UsageProblem

DECODERS: dict[str, type[Decoder]] = {"styleunet": StyleUNetDecoder, "blendshapes": BlendshapeDecoder}
_OF_OLD_FILES = "styleunet"  # files that name no decoder


def decoder_class(name: str) -> type[Decoder]:
    """The class of a decoder.

    Raises UsageProblem for a decoder that does not exist.
    """
    if name not in DECODERS:
        raise UsageProblem(
            f"There is no decoder called {name!r}.",
            "option --decoder",
            "Choose one of: " + ", ".join(DECODERS) + ".",
        )
    return DECODERS[name]


def new_decoder(maps: LayerMaps, config: ModelConfig, poses: int, seed: int = 0) -> Decoder:
    """A layer's decoder before training. `poses`: number of training poses.

    Raises UsageProblem for a decoder that does not exist.
    """
    return decoder_class(config.decoder).new(maps, config, poses, seed)


def load_decoder(config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> Decoder:
    """The decoder that its `config` and `state` describe.

    Raises BadData where they do not fit the maps, or the decoder is unknown.
    """
    name = config.get("decoder", _OF_OLD_FILES)
    if name not in DECODERS:
        raise BadData(
            f"The decoder {name!r} is unknown.",
            f"model of layer {maps.layer}",
            "Use a newer version of gw.",
        )
    if isinstance(config.get("ranks"), list):
        config = {**config, "ranks": tuple(config["ranks"])}
    return DECODERS[name].from_state(config, maps, tensors)

"""What a layer costs to play: multiply-adds per frame by component, joints, bytes.

Counted, not measured. A layer has no entry for what its decoder does without.
"""

from __future__ import annotations

import torch

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.decoders.components import bytes_by_component
from stages.shared.avatar.decoders.registry import decoder_class
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.used_joints import GROUPS

_MATRIX = 12  # one bone added to a texel's matrix
_POSED = 9 + 27 + 18  # centre, matrix times rotation, its square (six entries)
_PROJECTED = 90  # a Gaussian on the picture: kernels/project.py, counted by hand
_BLENDED = 17 * 31  # 17 a pixel, 31 pixels a Gaussian: 100,000 of them on a person, 512 × 512


def multiply_adds(
    maps: LayerMaps, config: ModelConfig, poses: int = 0, resting: tuple[str, ...] = ()
) -> dict[str, int]:
    """Multiply-adds of one frame by component, those that are not zero.

    Arguments:
        config: with the number of key poses that there are. poses: number of training poses.
        resting: groups of joints (`used_joints.GROUPS`) that do not move.
    """
    decoder = decoder_class(config.decoder)
    return _nonzero(maps, resting, decoder.multiply_adds(maps, config, poses, joints_used(maps, resting)))


def operations(decoder: Decoder, resting: tuple[str, ...] = ()) -> dict[str, int]:
    """`multiply_adds` of a decoder as it is."""
    joints = joints_used(decoder.maps, resting)
    return _nonzero(decoder.maps, resting, decoder.multiply_adds_as_is(joints))


def joints_used(maps: LayerMaps, resting: tuple[str, ...] = ()) -> int:
    """How many of the 55 joints a layer is skinned with while these groups rest."""
    return int((_merged_weights(maps, resting) != 0).any(dim=0).sum())


def costs(decoder: Decoder, resting: tuple[str, ...] = ()) -> dict[str, object]:
    """The costs of a layer that its manifest lists; plain JSON."""
    sizes = {name: tensor.numel() * tensor.element_size() for name, tensor in decoder.state().items()}
    return {
        "texels": len(decoder.maps),
        "joints": joints_used(decoder.maps, resting),
        "multiply_adds_per_frame": operations(decoder, resting),
        "bytes": bytes_by_component(sizes),
    }


def _nonzero(maps: LayerMaps, resting: tuple[str, ...], decoder: dict[str, int]) -> dict[str, int]:
    """Counts of skinning and splatting, and those of a decoder; without zeros."""
    texels, weights = len(maps), int((_merged_weights(maps, resting) > 1e-6).sum())
    counts = {
        "skinning": weights * _MATRIX + texels * _POSED,
        "splatting at 512 x 512": texels * (_PROJECTED + _BLENDED),
        **decoder,
    }
    return {name: count for name, count in counts.items() if count}


def _merged_weights(maps: LayerMaps, resting: tuple[str, ...]) -> torch.Tensor:
    """Skinning weights (N, 55) with those of resting joints added to the joint that carries them."""
    weights = maps.skin_weights.clone()
    for name in resting:
        members = list(GROUPS[name].members)
        weights[:, GROUPS[name].carrier] += weights[:, members].sum(dim=1)
        weights[:, members] = 0.0
    return weights

"""The attributes of a texel's Gaussian: the channels of a residual, and what every texel starts with.

Channels of a residual, in this order: Δp 3 (times `offset_scale`, metres), quaternion 4, opacity logit 1, log
scale 3, colour 3.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.maps import LayerMaps
from stages.shared.quaternions import quaternion_from_z

CHANNELS = {"offset": (0, 3), "quaternion": (3, 7), "opacity": (7, 8), "scale": (8, 11), "color": (11, 14)}
BASIS_GROUPS: dict[str, tuple[str, ...]] = {
    "offset": ("offset",),
    "color": ("color",),
    "form": ("quaternion", "opacity", "scale"),
}
RESIDUAL_CHANNELS = 14
MIN_SCALE = 1e-5
_FLATNESS = 0.3


def group_channels(group: str) -> list[int]:
    """The residual's channels that a group of `BASIS_GROUPS` moves."""
    return [channel for name in BASIS_GROUPS[group] for channel in range(*CHANNELS[name])]


def initial_attributes(maps: LayerMaps, config: ModelConfig) -> dict[str, Tensor]:
    """Initial base attributes: discs of the projected colours on the surface, or the published constants."""
    count = len(maps)
    log_spacing = maps.spacing.clamp(min=MIN_SCALE).log()[:, None].repeat(1, 3)
    quaternion = maps.positions.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    if not config.base:
        return {
            "offset": maps.positions.new_zeros(count, 3),
            "quaternion": quaternion,
            "opacity": maps.positions.new_zeros(count),
            "scale": log_spacing,
            "color": maps.positions.new_zeros(count, 3),
        }
    log_spacing[:, 2] += math.log(_FLATNESS)
    color = torch.logit(maps.colors.clamp(0.02, 0.98)) if config.color == "sigmoid" else maps.colors.clone()
    return {
        "offset": maps.positions.new_zeros(count, 3),
        "quaternion": quaternion_from_z(maps.normals),
        "opacity": torch.full_like(maps.spacing, math.log(0.9 / 0.1)),
        "scale": log_spacing,
        "color": color,
    }

"""The part of a layer that does not depend on the pose: free attributes per texel, and the activations.

Channels of a residual, in this order: Δp 3 (times `offset_scale`, metres), quaternion 4, opacity logit 1, log
scale 3, colour 3.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import asdict, fields
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.deform import Attributes, unit_quaternions
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData
from stages.shared.finite import require_finite

CHANNELS = {"offset": (0, 3), "quaternion": (3, 7), "opacity": (7, 8), "scale": (8, 11), "color": (11, 14)}
MIN_SCALE = 1e-5
_FLATNESS = 0.3


class TexelAttributes(nn.Module):
    """Gaussian attributes of one layer: what every texel is at rest plus what a decoder adds in a pose.

    Arguments:
        maps: baked maps of the layer. config: shape of the model.
    """

    base_offset: Tensor  # (N, 3) m
    base_quaternion: Tensor  # (N, 4)
    base_opacity: Tensor  # (N,) logit
    base_scale: Tensor  # (N, 3) log m
    base_color: Tensor  # (N, 3) logit, or plain with linear colours

    def __init__(self, maps: LayerMaps, config: ModelConfig) -> None:
        super().__init__()
        self.model_config, self.layer, self.maps = config, maps.layer, maps
        for name, start in _start(maps, config).items():
            if config.base:
                self.register_parameter(f"base_{name}", nn.Parameter(start))
            else:
                self.register_buffer(f"base_{name}", start)

    @property
    def config(self) -> dict[str, Any]:
        """All that is needed beside maps and tensors to make the model again; plain JSON."""
        return {"layer": self.layer, "texels": len(self.maps), **asdict(self.model_config)}

    def state(self) -> dict[str, Tensor]:
        """Every learned tensor (and the networks' fixed noise), float32, contiguous, on the CPU."""
        return {
            name: tensor.detach().cpu().contiguous().clone() for name, tensor in self.state_dict().items()
        }

    @classmethod
    def restored(
        cls,
        config: dict[str, Any],
        maps: LayerMaps,
        tensors: dict[str, Tensor],
        make: Callable[[ModelConfig], Self],
    ) -> Self:
        """What `make` makes of a configuration, with the tensors of its `state`.

        Raises BadData where configuration, maps and tensors do not fit together.
        """
        where = f"model of layer {maps.layer}"
        known = {field.name for field in fields(ModelConfig)}
        unknown = sorted(config.keys() - known - {"layer", "texels"})
        if unknown or config.get("texels") != len(maps):
            problem = f"unknown setting {unknown[0]!r}" if unknown else "number of texels"
            raise BadData(f"The model does not fit its maps ({problem}).", where, "Export or train it again.")
        model = make(ModelConfig(**{name: config[name] for name in known if name in config}))
        expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
        given = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if expected != given:
            name = sorted(expected.items() ^ given.items())[0][0]
            raise BadData(
                f"The tensor {name!r} is missing, extra or of a wrong shape.", where, "Train it again."
            )
        model.load_state_dict(tensors)
        return model

    def base_parameters(self) -> dict[str, Tensor]:
        """Free attributes by name (offset, quaternion, opacity, scale, color); empty when `base` is off."""
        if not self.model_config.base:
            return {}
        return {name: getattr(self, f"base_{name}") for name in CHANNELS}

    @abstractmethod
    def residual(
        self, local_transforms: Tensor, cosines: Tensor | None = None, motion: Tensor | None = None
    ) -> Tensor:
        """Pose-dependent part (N, 14) of the channels above.

        `local_transforms` (55, 4, 4): pose without shape and root. `cosines` (N,): normal · viewing direction
        of every texel, used only with view conditioning. `motion`: `recent_motion`, None for a still pose.
        """

    def attributes(self, residual: Tensor) -> Attributes:
        """Base attributes plus a residual (N, 14), through the heads' activations.

        Raises BadData where a residual is not finite: the activations would make a limit of infinity.
        """
        require_finite("attributes", residual=residual)
        widths = [high - low for low, high in CHANNELS.values()]
        part = dict(zip(CHANNELS, residual.split(widths, dim=1), strict=True))
        config = self.model_config
        log_scale = self.base_scale + part["scale"]
        if config.max_scale > 0:
            log_scale = log_scale.clamp(math.log(MIN_SCALE), math.log(config.max_scale))
        color = self.base_color + part["color"]
        return Attributes(
            offsets=self.base_offset + config.offset_scale * part["offset"],
            quaternions=unit_quaternions(self.base_quaternion + part["quaternion"]),
            scales=log_scale.exp(),
            opacities=torch.sigmoid(self.base_opacity + part["opacity"][:, 0]),
            colors=torch.sigmoid(color) if config.color == "sigmoid" else color,
        )

    def forward(
        self, local_transforms: Tensor, cosines: Tensor | None = None, motion: Tensor | None = None
    ) -> Attributes:
        """Attributes in a pose; arguments as in `residual`."""
        return self.attributes(self.residual(local_transforms, cosines, motion))


def _start(maps: LayerMaps, config: ModelConfig) -> dict[str, Tensor]:
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
        "quaternion": z_to(maps.normals),
        "opacity": torch.full_like(maps.spacing, math.log(0.9 / 0.1)),
        "scale": log_spacing,
        "color": color,
    }


def z_to(normals: Tensor) -> Tensor:
    """Unit quaternions (N, 4) wxyz that turn the z axis to `normals` (N, 3); a half turn about x for −z."""
    require_finite("z_to", normals=normals)
    normals = functional.normalize(normals, dim=1)
    x, y, z = normals.unbind(dim=1)
    quaternion = torch.stack((1 + z, -y, x, torch.zeros_like(x)), dim=1)  # (1 + z·n, z × n)
    opposite = (1 + z) < 1e-6
    quaternion = torch.where(opposite[:, None], quaternion.new_tensor([0.0, 1.0, 0.0, 0.0]), quaternion)
    return functional.normalize(quaternion, dim=1)

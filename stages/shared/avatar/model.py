"""The learned part of one layer: free attributes per texel and networks for what depends on the pose.

Every texel has base attributes (what plain splatting would optimise); StyleUNets read the posed positional
map and answer a residual of all 14 attribute channels, zero at the start. With `base=False` the base
attributes are the published constants and nothing but the networks learns.

Channels, in this order: Δp 3 (times `offset_scale`, metres), quaternion 4, opacity logit 1, log scale 3,
colour 3.
"""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from stages.shared.avatar.anchors import AnchorOffsets, sampled_maps
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.deform import Attributes, unit_quaternions
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.positional import CosineMaps, PositionalMaps, network_grid
from stages.shared.errors import BadData
from stages.shared.nets.styleunet import StyleUNet, ViewNet

CHANNELS = {"offset": (0, 3), "quaternion": (3, 7), "opacity": (7, 8), "scale": (8, 11), "color": (11, 14)}
_MIN_SCALE = 1e-5
_FLATNESS = 0.3
_USUAL_DEPARTURE = 0.05  # m, between poses, where the input is not normalised
_BODY_JOINTS = 22  # without face and fingers
_ROTATION_SHARE = 0.3 / (0.2 * math.sqrt(9 * _BODY_JOINTS))  # matrix entries usually differ by 0.2
_LEAST_DEPARTURE = 0.01  # m; less is noise, not motion


class LayerModel(nn.Module):
    """Gaussian attributes of one layer for any pose.

    Arguments:
        maps: baked maps of the layer. config: shape of the model. seed: of the initial network weights.
    """

    base_offset: Tensor  # (N, 3) m
    base_quaternion: Tensor  # (N, 4)
    base_opacity: Tensor  # (N,) logit
    base_scale: Tensor  # (N, 3) log m
    base_color: Tensor  # (N, 3) logit, or plain with linear colours
    sample_points: Tensor
    input_mean: Tensor  # (1, C, h, w) m
    input_scale: Tensor  # (1,) m
    mean_residual: Tensor  # (N, 14), with anchors
    fading: Tensor  # (1,), with anchors

    def __init__(self, maps: LayerMaps, config: ModelConfig | None = None, seed: int = 0) -> None:
        super().__init__()
        config = config or ModelConfig()
        self.model_config, self.layer = config, maps.layer
        self.maps = maps
        grid = network_grid(maps.window, config.factor, config.depth)
        self.positional = PositionalMaps(maps, grid, config.input_views)
        self.register_buffer("sample_points", _sample_points(maps, grid), persistent=False)
        self._front = int((maps.texels[:, 0] == 0).sum())
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            outputs = (14,) if config.heads == "joint" else (3, 3, 8)
            self.networks = nn.ModuleList(
                StyleUNet(
                    self.positional.channels,
                    count,
                    (grid.height, grid.width),
                    config.depth,
                    config.width,
                    config.style,
                )
                for count in outputs
            )
            self.view_net = ViewNet(config.width) if config.view_conditioning else None
        # Zero departure and unit scale until `fit_input` has seen the training poses.
        self.register_buffer("input_mean", torch.zeros(1, self.positional.channels, grid.height, grid.width))
        self.register_buffer("input_scale", torch.ones(1))
        self.anchors = None
        if config.anchors > 0 and maps.layer != "body":
            size = tuple(math.ceil(s * config.factor / config.anchor_cell) for s in (grid.height, grid.width))
            described = self.positional.channels * len(self.positional.used) + 9 * _BODY_JOINTS
            self.anchors = AnchorOffsets(config.anchors, size, described)  # type: ignore[arg-type]
            # What `fit_mean` finds after training; until then nothing fades.
            self.register_buffer("mean_residual", maps.positions.new_zeros(len(maps), 14))
            self.register_buffer("fading", torch.zeros(1))
        self.cosines = CosineMaps(maps, grid) if config.view_conditioning else None
        for name, start in _start(maps, config).items():
            if config.base:
                self.register_parameter(f"base_{name}", nn.Parameter(start))
            else:
                self.register_buffer(f"base_{name}", start)

    @property
    def config(self) -> dict[str, Any]:
        """All that `from_state` needs beside maps and tensors; plain JSON."""
        return {"layer": self.layer, "texels": len(self.maps), **asdict(self.model_config)}

    def state(self) -> dict[str, Tensor]:
        """Every learned tensor (and the networks' fixed noise), float32, contiguous, on the CPU."""
        return {
            name: tensor.detach().cpu().contiguous().clone() for name, tensor in self.state_dict().items()
        }

    @classmethod
    def from_state(cls, config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> LayerModel:
        """The model that `state` and `config` were taken from.

        Raises BadData where they do not fit the maps.
        """
        where = f"model of layer {maps.layer}"
        known = {field.name for field in fields(ModelConfig)}
        unknown = sorted(config.keys() - known - {"layer", "texels"})
        if unknown or config.get("texels") != len(maps):
            problem = f"unknown setting {unknown[0]!r}" if unknown else "number of texels"
            raise BadData(f"The model does not fit its maps ({problem}).", where, "Export or train it again.")
        model = cls(maps, ModelConfig(**{name: config[name] for name in known if name in config}))
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

    def fit_input(self, poses: list[Tensor]) -> None:
        """Look at the training poses, each (55, 4, 4) as in `residual`, before training starts.

        With `normalise`, the mean of the input is taken per pixel and its scale as one number, so that still
        parts stay small beside moving ones. Anchors are chosen among the poses.
        """
        if len(self.positional.used) == 0:
            return
        images = torch.cat([self.positional(pose) for pose in poses])
        if self.model_config.normalise:
            mean = images.mean(dim=0, keepdim=True)
            departure = (images - mean).flatten(start_dim=2)[:, :, self.positional.used]
            self.input_mean.copy_(mean)
            self.input_scale.copy_(departure.square().mean().sqrt().clamp(min=_LEAST_DEPARTURE))
        if self.anchors is not None:
            seen = (images - self.input_mean) / self.input_scale
            described = [
                self._description(image[None], pose) for image, pose in zip(seen, poses, strict=True)
            ]
            self.anchors.fit(torch.stack(described))

    @torch.no_grad()
    def fit_mean(self, poses: list[Tensor]) -> None:
        """Let poses unlike every anchor fade to the mean residual of training poses, each (55, 4, 4).

        What a network answers far from what it was trained with is a guess; the mean is a safer one. Call it
        once, when training is over.
        """
        if self.anchors is None or not poses:
            return
        self.fading.zero_()
        total = torch.zeros_like(self.mean_residual)
        for pose in poses:
            total += self.residual(pose)
        self.mean_residual.copy_(total / len(poses))
        self.fading.fill_(1.0)

    def residual(self, local_transforms: Tensor, cosines: Tensor | None = None) -> Tensor:
        """Pose-dependent part (N, 14) of the channels above, raw network output.

        `local_transforms` (55, 4, 4): pose without shape and root. `cosines` (N,): normal · viewing direction
        of every texel, used only with view conditioning (without it the colour network sees no view feature).
        """
        image = (self.positional(local_transforms) - self.input_mean) / self.input_scale
        if self.model_config.heads == "joint":
            return self._with_anchors(self._sampled(self.networks[0](image)[0]), image, local_transforms)
        features = None
        if self.view_net is not None and self.cosines is not None and cosines is not None:
            front, back = self.view_net(self.cosines(cosines))
            features = (front[None], back[None])
        color = self._sampled(self.networks[0](image, features)[0])
        offset = self._sampled(self.networks[1](image)[0])
        other = self._sampled(self.networks[2](image)[0])
        joined = torch.cat((offset, other[:, 4:8], other[:, 0:1], other[:, 1:4], color), dim=1)
        return self._with_anchors(joined, image, local_transforms)

    def attributes(self, residual: Tensor) -> Attributes:
        """Base attributes plus a residual (N, 14), through the heads' activations."""
        widths = [high - low for low, high in CHANNELS.values()]
        part = dict(zip(CHANNELS, residual.split(widths, dim=1), strict=True))
        config = self.model_config
        log_scale = self.base_scale + part["scale"]
        if config.max_scale > 0:
            log_scale = log_scale.clamp(math.log(_MIN_SCALE), math.log(config.max_scale))
        color = self.base_color + part["color"]
        return Attributes(
            offsets=self.base_offset + config.offset_scale * part["offset"],
            quaternions=unit_quaternions(self.base_quaternion + part["quaternion"]),
            scales=log_scale.exp(),
            opacities=torch.sigmoid(self.base_opacity + part["opacity"][:, 0]),
            colors=torch.sigmoid(color) if config.color == "sigmoid" else color,
        )

    def forward(self, local_transforms: Tensor, cosines: Tensor | None = None) -> Attributes:
        """Attributes in a pose; arguments as in `residual`."""
        return self.attributes(self.residual(local_transforms, cosines))

    def _sampled(self, images: Tensor) -> Tensor:
        """Maps (2, C, h, w) of the window at every texel (N, C)."""
        return sampled_maps(images, self.sample_points, self._front)

    def _with_anchors(self, residual: Tensor, image: Tensor, local_transforms: Tensor) -> Tensor:
        """Add the anchors' offsets for a pose to a residual (N, 14), and fade where no anchor is near."""
        if self.anchors is None:
            return residual
        description = self._description(image, local_transforms)
        offsets = self._sampled(self.anchors(description)) / self.model_config.offset_scale
        residual = torch.cat((residual[:, :3] + offsets, residual[:, 3:]), dim=1)
        share = 1.0 - self.fading * (1.0 - self.anchors.familiarity(description))
        return torch.lerp(self.mean_residual, residual, share)

    def _description(self, image: Tensor, local_transforms: Tensor) -> Tensor:
        """What tells poses apart, (M + 198,): the input image where there are texels, and joint rotations.

        Both parts are scaled so that a usual difference between poses is about 1, and 0.3 for the rotations.
        """
        seen = image[0].flatten(start_dim=1)[:, self.positional.used].flatten()
        turned = local_transforms[:_BODY_JOINTS, :3, :3].flatten()
        usual = 1.0 if self.model_config.normalise else _USUAL_DEPARTURE
        return torch.cat((seen / (usual * math.sqrt(max(len(seen), 1))), turned * _ROTATION_SHARE))


def _sample_points(maps: LayerMaps, grid: Any) -> Tensor:
    """Where each texel lies on the network's images: (N, 2) x, y in −1..1 from edge to edge."""
    _, row, column = maps.window_texels
    x = (column + grid.column + 0.5) / (grid.width * grid.factor)
    y = (row + grid.row + 0.5) / (grid.height * grid.factor)
    return torch.stack((x, y), dim=1).float() * 2 - 1


def _start(maps: LayerMaps, config: ModelConfig) -> dict[str, Tensor]:
    """Initial base attributes: discs of the projected colours on the surface, or the published constants."""
    count = len(maps)
    log_spacing = maps.spacing.clamp(min=_MIN_SCALE).log()[:, None].repeat(1, 3)
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
    normals = functional.normalize(normals, dim=1)
    x, y, z = normals.unbind(dim=1)
    quaternion = torch.stack((1 + z, -y, x, torch.zeros_like(x)), dim=1)  # (1 + z·n, z × n)
    opposite = (1 + z) < 1e-6
    quaternion = torch.where(opposite[:, None], quaternion.new_tensor([0.0, 1.0, 0.0, 0.0]), quaternion)
    return functional.normalize(quaternion, dim=1)

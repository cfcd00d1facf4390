"""The decoder "blendshapes": per-texel bases times a few coefficients that depend on the pose. Real time.

residual = mean + Σ_k c_k(pose) B_k, the form of the pose correctives of body models (SMPL, eq. 9). Offsets,
colours and form (quaternion, opacity, scale) have bases of their own. The coefficients c come from a Gaussian
kernel between the pose and the training poses, so the mean remains far from all of them. A frame costs one
small matrix product per layer instead of a convolutional network.

The decoder is trained directly (`fit_input` lays out the coefficients; the bases start at zero and are
learned) or distilled from a trained network (`stages/distill`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.base import Decoder, DecoderCost, LinearResidual
from stages.shared.avatar.decoders.key_poses import spread_out
from stages.shared.avatar.decoders.texel_attributes import BASIS_GROUPS, group_channels
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import motion_length, motion_scale
from stages.shared.errors import BadData
from stages.shared.finite import require_finite

BODY_JOINTS = 22  # without face and fingers
_MOST_CENTRES, _MOST_RANK = 4096, 256
_LEAST_SPREAD = 1e-6
_LEAST_MOTION = 0.05  # m/s, rad/s; less is noise, not motion
# Computed, not measured: seven passes over memory (forward, backward, Adam) at 4 GB/s.
_SECONDS_PER_NUMBER = 8e-9
_BASE_CHANNELS = 14


@dataclass(frozen=True)
class BlendshapeSizes:
    """Sizes that the data decide: numbers of bases by group, and of kernel centres."""

    offset: int
    color: int
    form: int
    centres: int


class PoseCoefficients(nn.Module):
    """Numbers c(pose) (K,) = Σ_m w_mk k(pose, centre_m), k a Gaussian of the distance between poses.

    A pose is described by the rotations of the 22 body joints without the root, as matrix entries, and with
    history by the recent motion, each of its numbers times a scale.
    """

    centres: Tensor  # (M, 198 + H) described poses
    motion_scale: Tensor  # (H,)
    bandwidth: Tensor  # (1,)
    weights: Tensor  # (M, K)

    def __init__(self, centres: int, count: int, history: int) -> None:
        super().__init__()
        moving = motion_length(history)
        self.register_buffer("centres", torch.zeros(centres, 9 * BODY_JOINTS + moving))
        # Empty without history, and a bundle holds no empty tensors.
        self.register_buffer("motion_scale", torch.ones(moving), persistent=moving > 0)
        self.register_buffer("bandwidth", torch.ones(1))
        self.register_buffer("weights", torch.zeros(centres, count))

    def describe(self, local_transforms: Tensor, motion: Tensor | None) -> Tensor:
        """What tells poses apart: (198 + H,); no motion is a still pose."""
        turned = local_transforms[:BODY_JOINTS, :3, :3].flatten()
        moving = torch.zeros_like(self.motion_scale) if motion is None else motion * self.motion_scale
        return torch.cat((turned, moving)) if len(moving) else turned

    def forward(self, local_transforms: Tensor, motion: Tensor | None = None) -> Tensor:
        """(55, 4, 4) bone transforms without shape and root, (H,) recent motion -> (K,)."""
        require_finite("PoseCoefficients", local_transforms=local_transforms, motion=motion)
        described = self.describe(local_transforms, motion)[None]
        return (gaussian_kernel(described, self.centres, self.bandwidth) @ self.weights)[0]


def gaussian_kernel(one: Tensor, other: Tensor, bandwidth: Tensor) -> Tensor:
    """exp(−|a − b|² / 2h²) of rows: (T, F), (M, F) -> (T, M)."""
    # The exact form of the distance: the quick one loses near poses in rounding.
    distance = torch.cdist(one, other, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-0.5 * (distance / bandwidth).square())


class BlendshapeDecoder(Decoder):
    """Gaussian attributes of one layer for any pose, by blendshapes.

    Arguments:
        maps: baked maps of the layer. config: with `decoder="blendshapes"`. sizes: numbers of bases.
    """

    mean_residual: Tensor  # (N, 14)
    channel_order: Tensor

    def __init__(self, maps: LayerMaps, config: ModelConfig, sizes: BlendshapeSizes) -> None:
        super().__init__(maps, config)
        self.sizes = sizes
        count = sizes.offset + sizes.color + sizes.form
        self.coefficients = PoseCoefficients(sizes.centres, count, config.history)
        self.register_buffer("mean_residual", maps.positions.new_zeros(len(maps), 14))
        for group in BASIS_GROUPS:
            # Texels first: the product with the coefficients then reads memory once, in order.
            shape = (len(maps), len(group_channels(group)), getattr(sizes, group))
            self.register_parameter(f"basis_{group}", nn.Parameter(torch.zeros(shape)))
        order = torch.tensor([channel for group in BASIS_GROUPS for channel in group_channels(group)])
        self.register_buffer("channel_order", order.argsort(), persistent=False)

    @property
    def config(self) -> dict[str, Any]:
        sizes = {name: getattr(self.sizes, name) for name in ("offset", "color", "form", "centres")}
        return {**super().config, "blendshapes": sizes}

    @classmethod
    def resolved(cls, config: ModelConfig) -> ModelConfig:
        """Without networks, key poses and pose prior. Base attributes are what the bases add to."""
        return replace(config, networks="none", anchors=0, pose_prior=0, view_conditioning=False, base=True)

    @classmethod
    def new(cls, maps: LayerMaps, config: ModelConfig, poses: int, seed: int) -> Self:
        return cls(maps, config, BlendshapeSizes(*config.ranks, poses))

    @classmethod
    def from_state(cls, config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> Self:
        sizes = _checked_sizes(config.get("blendshapes"), maps.layer)
        settings = {name: value for name, value in config.items() if name != "blendshapes"}
        return cls.restored(settings, maps, tensors, lambda model_config: cls(maps, model_config, sizes))

    @classmethod
    def cost(cls, maps: LayerMaps, config: ModelConfig) -> DecoderCost:
        numbers = len(maps) * _numbers_per_texel(*config.ranks)
        base = _BASE_CHANNELS * len(maps) if config.base else 0
        return DecoderCost(base + numbers, numbers * _SECONDS_PER_NUMBER)

    @classmethod
    def multiply_adds(cls, maps: LayerMaps, config: ModelConfig, poses: int, joints: int) -> dict[str, int]:
        return _multiply_adds(len(maps), config, BlendshapeSizes(*config.ranks, poses))

    def multiply_adds_as_is(self, joints: int) -> dict[str, int]:
        return _multiply_adds(len(self.maps), self.model_config, self.sizes)

    def own_step_sizes(self, step_sizes: Mapping[str, float]) -> dict[str, float]:
        """K bases of unit coefficients together move as fast as the attribute alone, in residual units.

        A group of several attributes takes the smallest step of them.
        """
        per_unit = {
            "offset": step_sizes["offset"] / self.model_config.offset_scale,
            "color": step_sizes["color"],
            "form": min(step_sizes[name] for name in BASIS_GROUPS["form"]),
        }
        return {
            f"basis_{group}": per_unit[group] / math.sqrt(max(getattr(self.sizes, group), 1))
            for group in BASIS_GROUPS
        }

    def linear_residual(self) -> LinearResidual:
        bases = {group: getattr(self, f"basis_{group}") for group in BASIS_GROUPS}
        if not self.all_observed:
            weight = self.observed[:, None, None]
            bases = {group: b if group == "offset" else b * weight for group, b in bases.items()}
        return LinearResidual(self.observed_residual(self.mean_residual), bases, self.coefficients)

    def fit_input(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
        """Lay out the coefficients over training poses, each (55, 4, 4), before the bases are learned.

        Kernel principal components of the poses, each of unit variance over them: the bases that come first
        belong to the motion that there is most of.
        """
        described = self.fit_description(poses, motions)
        distance = torch.cdist(described, described, compute_mode="donot_use_mm_for_euclid_dist")
        chosen = spread_out(distance, min(self.sizes.centres, len(described)))
        centres = described[chosen]
        bandwidth = neighbour_distance(centres).clamp(min=_LEAST_SPREAD) * 2.0
        kernel = gaussian_kernel(described, centres, bandwidth)
        _, spread, axes = torch.linalg.svd(kernel - kernel.mean(dim=0), full_matrices=False)
        unit = axes.T * (len(described) ** 0.5 / spread.clamp(min=_LEAST_SPREAD * spread[0].clamp(min=1e-12)))
        self.coefficients.centres[: len(centres)] = centres
        self.coefficients.bandwidth.copy_(bandwidth)
        first = 0
        for group in BASIS_GROUPS:
            count = min(getattr(self.sizes, group), unit.shape[1])
            self.coefficients.weights[: len(centres), first : first + count] = unit[:, :count]
            first += getattr(self.sizes, group)

    def fit_description(self, poses: list[Tensor], motions: list[Tensor] | None) -> Tensor:
        """(T, 198 + H) descriptions of poses, after the scale of motion is set by them."""
        if motions and self.model_config.history:
            turned = torch.stack([pose[:BODY_JOINTS, :3, :3].flatten() for pose in poses])
            usual = (turned - turned.mean(dim=0)).square().sum(dim=1).mean().sqrt()
            scale = motion_scale(torch.stack(motions), usual, _LEAST_MOTION)
            self.coefficients.motion_scale.copy_(scale)
        still: list[None] = [None] * len(poses)
        pairs = zip(poses, motions or still, strict=True)
        return torch.stack([self.coefficients.describe(pose, motion) for pose, motion in pairs])

    def residual(
        self, local_transforms: Tensor, cosines: Tensor | None = None, motion: Tensor | None = None
    ) -> Tensor:
        """Pose-dependent part (N, 14); see `Decoder.residual`."""
        values = self.coefficients(local_transforms, motion)
        values = values.split([getattr(self.sizes, group) for group in BASIS_GROUPS])
        parts = [
            getattr(self, f"basis_{group}") @ part for group, part in zip(BASIS_GROUPS, values, strict=True)
        ]
        return self.mean_residual + torch.cat(parts, dim=1)[:, self.channel_order]


def neighbour_distance(described: Tensor) -> Tensor:
    """(1,) median distance of each row to its nearest other."""
    distance = torch.cdist(described, described, compute_mode="donot_use_mm_for_euclid_dist")
    distance.fill_diagonal_(float("inf"))
    nearest = distance.min(dim=1).values
    finite = nearest[torch.isfinite(nearest)]
    return finite.median()[None] if len(finite) else described.new_ones(1)


def _numbers_per_texel(offset: int, color: int, form: int) -> int:
    """Learned numbers of a texel's bases."""
    ranks = {"offset": offset, "color": color, "form": form}
    return sum(len(group_channels(group)) * rank for group, rank in ranks.items())


def _multiply_adds(texels: int, config: ModelConfig, sizes: BlendshapeSizes) -> dict[str, int]:
    """Multiply-adds of one pose by component."""
    description = 9 * BODY_JOINTS + motion_length(config.history)
    count = sizes.offset + sizes.color + sizes.form
    return {
        "blendshapes": texels * _numbers_per_texel(sizes.offset, sizes.color, sizes.form),
        "pose coefficients": sizes.centres * (description + count),
    }


def _checked_sizes(sizes: Any, layer: str) -> BlendshapeSizes:
    names = [field.name for field in fields(BlendshapeSizes)]
    values = sizes if isinstance(sizes, dict) else {}
    for name in names:
        value = values.get(name)
        most = _MOST_CENTRES if name == "centres" else _MOST_RANK
        if type(value) is not int or not 0 <= value <= most:
            raise BadData(
                f"The number of blendshapes {name!r} is {value!r}.",
                f"model of layer {layer}",
                "Export or train it again.",
            )
    return BlendshapeSizes(**{name: values[name] for name in names})

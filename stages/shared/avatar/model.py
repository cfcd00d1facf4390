"""The learned part of one layer: free attributes per texel, and what depends on the pose.

Every texel has base attributes (what plain splatting would optimise, `TexelAttributes`); StyleUNets read the
posed positional map and answer a residual of all 14 attribute channels, zero at the start. A layer without
networks (`ModelConfig.networks`) keeps its base attributes; garments move by their anchors' offsets, with or
without networks. With `base=False` the base attributes are the published constants, and only networks learn.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from stages.shared.avatar.anchors import AnchorOffsets, sampled_maps
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.fallback import shrunken_mean
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.motion import motion_length, motion_scale
from stages.shared.avatar.pose_prior import PosePrior
from stages.shared.avatar.positional import CosineMaps, PositionalMaps, network_grid
from stages.shared.avatar.texel_attributes import TexelAttributes
from stages.shared.nets.styleunet import StyleUNet, ViewNet

_USUAL_DEPARTURE = 0.05  # m, between poses, where the input is not normalised
_BODY_JOINTS = 22  # without face and fingers
_ROTATION_SHARE = 0.3 / (0.2 * math.sqrt(9 * _BODY_JOINTS))  # matrix entries usually differ by 0.2
_MOTION_SHARE = 0.5  # usual difference of each memory of recent motion
_LEAST_MOTION = 0.01  # m/s and rad/s; less is noise
_LEAST_DEPARTURE = 0.01  # m; less is noise, not motion


class LayerModel(TexelAttributes):
    """Gaussian attributes of one layer for any pose.

    Arguments:
        maps: baked maps of the layer. config: shape of the model. seed: of the initial network weights.
    """

    sample_points: Tensor
    input_mean: Tensor  # (1, C, h, w) m
    input_scale: Tensor  # (1,) m
    mean_residual: Tensor  # (N, 14), with anchors
    fading: Tensor  # (1,), with anchors
    motion_scale: Tensor  # (H,), with history

    def __init__(self, maps: LayerMaps, config: ModelConfig | None = None, seed: int = 0) -> None:
        config = config or ModelConfig()
        super().__init__(maps, config)
        grid = network_grid(maps.window, config.factor, config.depth)
        self.positional = PositionalMaps(maps, grid, config.input_views)
        self.register_buffer("sample_points", _sample_points(maps, grid), persistent=False)
        self._view_counts = maps.view_counts
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            outputs = config.networks_of(maps.layer)
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
            self.view_net = ViewNet(config.width) if config.view_conditioning and outputs else None
        # Zero departure and unit scale until `fit_input` has seen the training poses.
        self.register_buffer("input_mean", torch.zeros(1, self.positional.channels, grid.height, grid.width))
        self.register_buffer("input_scale", torch.ones(1))
        self.anchors = None
        if config.anchors > 0 and maps.layer != "body":
            size = tuple(math.ceil(s * config.factor / config.anchor_cell) for s in (grid.height, grid.width))
            described = self.positional.channels * len(self.positional.used) + 9 * _BODY_JOINTS
            described += motion_length(config.history)
            if config.history:
                self.register_buffer("motion_scale", torch.ones(motion_length(config.history)))
            own = config.anchor_widths == "own"
            self.anchors = AnchorOffsets(config.anchors, size, described, own)  # type: ignore[arg-type]
            # What `fit_mean` finds after training; until then nothing fades.
            self.register_buffer("mean_residual", maps.positions.new_zeros(len(maps), 14))
            self.register_buffer("fading", torch.zeros(1))
        self.cosines = CosineMaps(maps, grid) if config.view_conditioning else None
        self.prior = None
        if config.pose_prior > 0 and outputs:
            values = self.positional.channels * len(self.positional.used)
            self.prior = PosePrior(config.pose_prior, values, config.pose_sigma)

    @classmethod
    def from_state(cls, config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> LayerModel:
        """The model that `state` and `config` were taken from.

        Raises BadData where they do not fit the maps.
        """
        return cls.restored(config, maps, tensors, lambda model_config: cls(maps, model_config))

    def fit_input(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
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
            self.fit_anchors(poses, motions)

    def fit_anchors(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> Tensor:
        """Choose the anchors among poses as in `fit_input`, leaving what the networks see; (K,) which."""
        assert self.anchors is not None
        if self.model_config.history and motions:
            self.motion_scale.copy_(motion_scale(torch.stack(motions), _MOTION_SHARE, _LEAST_MOTION))
        still: list[None] = [None] * len(poses)
        described = [
            self._description((self.positional(pose) - self.input_mean) / self.input_scale, pose, motion)
            for pose, motion in zip(poses, motions or still, strict=True)
        ]
        return self.anchors.fit(torch.stack(described))

    @torch.no_grad()
    def fit_mean(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
        """Let poses unlike every anchor fade to a share of the training's mean residual.

        What a network answers far from what it was trained with is a guess; the mean is a safer one, and how
        much of it is found by leaving out parts of the take (`shrunken_mean`). `poses`, (55, 4, 4) each, are
        in order of time. Call it once, when training is over. From here on, poses outside the training's are
        projected on its prior.
        """
        if not poses:
            return
        if self.anchors is not None:
            self._fit_fading(poses, motions)
        if self.prior is not None:
            self.prior.fit(torch.stack([self._seen(self.positional(pose)) for pose in poses]))

    @torch.no_grad()
    def projected(self, local_transforms: Tensor) -> bool:
        """Whether a pose (55, 4, 4) is outside the training's, so that the networks see its projection."""
        return self.prior is not None and self.prior.outside(self._seen(self.positional(local_transforms)))

    def _fit_fading(self, poses: list[Tensor], motions: list[Tensor] | None) -> None:
        self.fading.zero_()
        still: list[None] = [None] * len(poses)
        seen = list(zip(poses, motions or still, strict=True))
        mean, _ = shrunken_mean(lambda index: self.residual(seen[index][0], motion=seen[index][1]), len(seen))
        self.mean_residual.copy_(mean)
        self.fading.fill_(1.0)

    def residual(
        self, local_transforms: Tensor, cosines: Tensor | None = None, motion: Tensor | None = None
    ) -> Tensor:
        """Pose-dependent part (N, 14) of the channels above, raw network output.

        `local_transforms` (55, 4, 4): pose without shape and root. `cosines` (N,): normal · viewing direction
        of every texel, used only with view conditioning (without it the colour network sees no view feature).
        `motion` (M,): `recent_motion`, used only with history; None for a still pose.
        """
        answer = self.of_networks(local_transforms, cosines)
        if self.anchors is None:
            return answer
        seen = (self.positional(local_transforms) - self.input_mean) / self.input_scale
        return self._with_anchors(answer, seen, local_transforms, motion)

    def of_networks(self, local_transforms: Tensor, cosines: Tensor | None = None) -> Tensor:
        """What the networks alone add in a pose (N, 14); arguments as in `residual`."""
        if not len(self.networks):
            return self.base_color.new_zeros(len(self.maps), 14)
        image = (self._input(self.positional(local_transforms)) - self.input_mean) / self.input_scale
        if self.model_config.heads == "joint":
            return self._sampled(self.networks[0](image)[0])
        features = None
        if self.view_net is not None and self.cosines is not None and cosines is not None:
            front, back = self.view_net(self.cosines(cosines))
            features = (front[None], back[None])
        color = self._sampled(self.networks[0](image, features)[0])
        offset = self._sampled(self.networks[1](image)[0])
        other = self._sampled(self.networks[2](image)[0])
        return torch.cat((offset, other[:, 4:8], other[:, 0:1], other[:, 1:4], color), dim=1)

    def _input(self, image: Tensor) -> Tensor:
        """The positional map of a pose, or of the nearest one that the training would explain."""
        if self.prior is None or not bool(self.prior.limit > 0):
            return image
        known = self.prior(self._seen(image)).view(*image.shape[:2], -1)
        return image.flatten(start_dim=2).index_copy(2, self.positional.used, known).view_as(image)

    def _seen(self, image: Tensor) -> Tensor:
        """The values of an image (1, C, h, w) where there are texels, in a row."""
        return image.flatten(start_dim=2)[:, :, self.positional.used].flatten()

    def _sampled(self, images: Tensor) -> Tensor:
        """Maps (2, C, h, w) of the window at every texel (N, C)."""
        return sampled_maps(images, self.sample_points, self._view_counts)

    def _with_anchors(
        self, residual: Tensor, image: Tensor, local_transforms: Tensor, motion: Tensor | None
    ) -> Tensor:
        """Add the anchors' offsets for a pose to a residual (N, 14), and fade where no anchor is near."""
        assert self.anchors is not None
        description = self._description(image, local_transforms, motion)
        offsets = self._sampled(self.anchors(description)) / self.model_config.offset_scale
        residual = torch.cat((residual[:, :3] + offsets, residual[:, 3:]), dim=1)
        share = 1.0 - self.fading * (1.0 - self.anchors.familiarity(description))
        return torch.lerp(self.mean_residual, residual, share)

    def _description(self, image: Tensor, local_transforms: Tensor, motion: Tensor | None) -> Tensor:
        """What tells poses apart, (M + 198 + H,): the input image where there are texels, joint rotations,
        and with history the recent motion.

        Parts are scaled so that a usual difference between poses is about 1, and 0.3 for the rotations.
        """
        seen = image[0].flatten(start_dim=1)[:, self.positional.used].flatten()
        turned = local_transforms[:_BODY_JOINTS, :3, :3].flatten()
        usual = 1.0 if self.model_config.normalise else _USUAL_DEPARTURE
        parts = [seen / (usual * math.sqrt(max(len(seen), 1))), turned * _ROTATION_SHARE]
        if self.model_config.history:
            moving = self.motion_scale * 0.0 if motion is None else motion * self.motion_scale
            parts.append(moving)
        return torch.cat(parts)


def _sample_points(maps: LayerMaps, grid: Any) -> Tensor:
    """Where each texel lies on the network's images: (N, 2) x, y in −1..1 from edge to edge."""
    _, row, column = maps.window_texels
    x = (column + grid.column + 0.5) / (grid.width * grid.factor)
    y = (row + grid.row + 0.5) / (grid.height * grid.factor)
    return torch.stack((x, y), dim=1).float() * 2 - 1

"""The decoder "styleunet": convolutional networks, and free offsets of key poses.

StyleUNets read the posed positional map and predict a residual of all 14 attribute channels. They start at
zero. A layer without networks (`ModelConfig.networks`) keeps its base attributes. Garments also have key
poses (`key_poses.py`), with or without networks. With `base=False` the base attributes are the published
constants, and only networks learn.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders import styleunet_cost
from stages.shared.avatar.decoders.base import Decoder, DecoderCost, LinearResidual
from stages.shared.avatar.decoders.key_poses import KeyPoseOffsets, sampled_maps
from stages.shared.avatar.decoders.pose_prior import PosePrior, shrunken_mean
from stages.shared.avatar.decoders.positional_maps import CosineMaps, PositionalMaps, network_grid
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import motion_length, motion_scale
from stages.shared.errors import UsageProblem
from stages.shared.layers import BODY
from stages.shared.nets.styleunet import StyleUNet, ViewNet

_USUAL_DEPARTURE = 0.05  # m, between poses, where the input is not normalised
_BODY_JOINTS = 22  # without face and fingers
_ROTATION_SHARE = 0.3 / (0.2 * math.sqrt(9 * _BODY_JOINTS))  # matrix entries usually differ by 0.2
_MOTION_SHARE = 0.5  # usual difference of each memory of recent motion
_LEAST_MOTION = 0.01  # m/s and rad/s; less is noise
_LEAST_DEPARTURE = 0.01  # m; less is noise, not motion
_OF_A_TAKE = ("anchors.", "mean_residual", "fading", "motion_scale", "prior.")  # not taken to another take


class StyleUNetDecoder(Decoder):
    """Gaussian attributes of one layer for any pose.

    Arguments:
        maps: baked maps of the layer. config: shape of the model. seed: of the initial network weights.
    """

    followed = True
    sample_points: Tensor
    input_mean: Tensor  # (1, C, h, w) m
    input_scale: Tensor  # (1,) m
    mean_residual: Tensor  # (N, 14), with key poses
    fading: Tensor  # (1,) 1 once unknown poses fade to the mean, with key poses
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
        if config.anchors > 0 and maps.layer != BODY:
            size = styleunet_cost.key_pose_map(grid, config)
            described = self.positional.channels * len(self.positional.used) + 9 * _BODY_JOINTS
            described += motion_length(config.history)
            if config.history:
                self.register_buffer("motion_scale", torch.ones(motion_length(config.history)))
            own = config.anchor_widths == "own"
            points = self.sample_points
            self.anchors = KeyPoseOffsets(  # under this name in stored states
                config.anchors,
                size,
                described,
                own,
                points,
                config.anchor_cell,
            )
            # `fit_mean` sets them after training; until then nothing fades.
            self.register_buffer("mean_residual", maps.positions.new_zeros(len(maps), 14))
            self.register_buffer("fading", torch.zeros(1))
        self.cosines = CosineMaps(maps, grid) if config.view_conditioning else None
        self.prior = None
        if config.pose_prior > 0 and outputs:
            values = self.positional.channels * len(self.positional.used)
            self.prior = PosePrior(config.pose_prior, values, config.pose_sigma)

    @classmethod
    def new(cls, maps: LayerMaps, config: ModelConfig, poses: int, seed: int) -> Self:
        return cls(maps, config, seed)

    @classmethod
    def from_state(cls, config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> Self:
        return cls.restored(config, maps, tensors, lambda model_config: cls(maps, model_config))

    @classmethod
    def cost(cls, maps: LayerMaps, config: ModelConfig) -> DecoderCost:
        return styleunet_cost.cost(maps, config)

    @classmethod
    def multiply_adds(cls, maps: LayerMaps, config: ModelConfig, poses: int, joints: int) -> dict[str, int]:
        return styleunet_cost.multiply_adds(maps, config, joints)

    @classmethod
    def omitted(cls, maps: LayerMaps, config: ModelConfig) -> dict[str, str]:
        if config.networks_of(maps.layer):
            return {}
        return {f"networks of {maps.layer}": f"--networks {config.networks}"}

    def warm_start(self, maps: LayerMaps, config: ModelConfig) -> Self:
        """Networks and base attributes are taken over; key poses and history are those of `config`.

        Raises:
            UsageProblem: this decoder has key poses, and `config` has none.
        """
        if self.anchors is not None and not config.anchors:
            raise UsageProblem(
                f"The layer {self.layer} was learned with anchors, and this run has none.",
                "option --from-subject",
                "Train both subjects with the same preset and the same --without.",
            )
        settings = replace(
            self.model_config,
            anchors=config.anchors,
            anchor_cell=config.anchor_cell,
            anchor_widths=config.anchor_widths,
            history=config.history,
        )
        started = type(self)(maps, settings)
        tensors = {
            name: t for name, t in self.state().items() if not name.startswith((*_OF_A_TAKE, "observed"))
        }
        missing, _ = started.load_state_dict(tensors, strict=False)
        assert all(name.startswith(_OF_A_TAKE) for name in missing)
        started.set_observed(self.observed)
        return started

    @property
    def key_poses(self) -> KeyPoseOffsets | None:
        return self.anchors

    @property
    def projects(self) -> bool:
        return self.prior is not None

    def keep_activations(self, keep: bool) -> None:
        for network in self.networks:
            network.recompute = not keep  # type: ignore[assignment]

    def linear_residual(self) -> LinearResidual | None:
        if self.anchors is not None or len(self.networks):
            return None
        return LinearResidual(torch.zeros(len(self.maps), 14))

    def mean_residual_of_training(self) -> Tensor:
        return self.mean_residual if self.anchors is not None else super().mean_residual_of_training()

    def fit_input(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
        """Normalise the networks' input over the training poses, and choose key poses among them.

        With `normalise`, the mean of the input is taken per pixel and its scale as one number, so that parts
        that do not move stay small.
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
            self.fit_key_poses(poses, motions)

    def fit_key_poses(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> Tensor:
        """Choose key poses among poses as in `fit_input`; the networks' input stays. Returns which (K,)."""
        if self.anchors is None:
            return super().fit_key_poses(poses, motions)
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
        """Let poses unlike every key pose fade to a share of the training's mean residual.

        Far from its training poses a network only guesses. The mean is safer; `shrunken_mean` finds how much
        of it to use by leaving out parts of the take. `poses`, (55, 4, 4) each, are in order of time. Call it
        once, when training is over. Afterwards poses outside the training's are projected on its prior.
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
        """Pose-dependent part (N, 14), raw network output.

        `local_transforms` (55, 4, 4): pose without shape and root. `cosines` (N,): normal · viewing direction
        of every texel, used only with view conditioning (without it the colour network sees no view feature).
        `motion` (M,): `recent_motion`, used only with history; None for a still pose.
        """
        residual = self._network_residual(local_transforms, cosines)
        if self.anchors is None:
            return residual
        image = (self.positional(local_transforms) - self.input_mean) / self.input_scale
        return self._with_key_poses(residual, image, local_transforms, motion)

    def residual_without_key_poses(self, local_transforms: Tensor, motion: Tensor | None = None) -> Tensor:
        return self._network_residual(local_transforms)

    def _network_residual(self, local_transforms: Tensor, cosines: Tensor | None = None) -> Tensor:
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

    def _with_key_poses(
        self, residual: Tensor, image: Tensor, local_transforms: Tensor, motion: Tensor | None
    ) -> Tensor:
        """Add the offsets of key poses to a residual (N, 14); fade to the mean where no key pose is near."""
        assert self.anchors is not None
        description = self._description(image, local_transforms, motion)
        offsets = self._sampled(self.anchors(description)) / self.model_config.offset_scale
        residual = torch.cat((residual[:, :3] + offsets, residual[:, 3:]), dim=1)
        share = 1.0 - self.fading * (1.0 - self.anchors.confidence(description))
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

"""What every decoder of a layer is: free attributes per texel, and a part that depends on the pose.

A decoder turns a pose into the Gaussian attributes of one layer. `registry.py` lists the decoders. A new one
is a subclass of `Decoder` in a module of its own, and an entry there.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor, nn

from stages.shared.artifacts.bundle_model import check_model
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.texel_attributes import CHANNELS, MIN_SCALE, initial_attributes
from stages.shared.avatar.deform import Attributes
from stages.shared.avatar.maps import LayerMaps
from stages.shared.errors import BadData
from stages.shared.finite import require_finite
from stages.shared.quaternions import unit_quaternions

if TYPE_CHECKING:
    from stages.shared.avatar.decoders.key_poses import KeyPoseOffsets


@dataclass(frozen=True)
class DecoderCost:
    """What a decoder needs, known from maps and settings before it is made.

    Attributes:
        parameters: learned numbers, base attributes included.
        seconds: a forward and a backward pass on two CPU cores, without skinning and splatting.
        activation_bytes: kept for the backward pass, one number per network.
        fit_values: values per training pose that `Decoder.fit_mean` decomposes.
    """

    parameters: int
    seconds: float = 0.0
    activation_bytes: tuple[float, ...] = ()
    fit_values: float = 0.0


@dataclass(frozen=True, eq=False)
class LinearResidual:
    """A residual of the form mean + Σ_k c_k(pose) B_k, which the posing kernel evaluates itself.

    Attributes:
        mean: (N, 14).
        bases: group of `texel_attributes.BASIS_GROUPS` to (N, C, K); None where no pose changes the layer.
        coefficients: local transforms (55, 4, 4) and recent motion to c, (K of all groups in order,); None
            likewise.
    """

    mean: Tensor
    bases: Mapping[str, Tensor] | None = None
    coefficients: Callable[[Tensor, Tensor | None], Tensor] | None = None


class Decoder(nn.Module, ABC):
    """Gaussian attributes of one layer: free base attributes per texel plus a residual for the pose.

    Arguments:
        maps: baked maps of the layer. config: its settings.
    """

    followed: ClassVar[bool] = False
    """Whether a decoder of this class can have key poses, so that garments can be followed through a take."""

    base_offset: Tensor  # (N, 3) m
    base_quaternion: Tensor  # (N, 4)
    base_opacity: Tensor  # (N,) logit
    base_scale: Tensor  # (N, 3) log m
    base_color: Tensor  # (N, 3) logit, or plain with linear colours
    observed: Tensor  # (N,) 1 for texels that cameras see, 0 for those that none sees; `set_observed`

    def __init__(self, maps: LayerMaps, config: ModelConfig) -> None:
        super().__init__()
        self.model_config, self.layer, self.maps = config, maps.layer, maps
        for name, start in initial_attributes(maps, config).items():
            if config.base:
                self.register_parameter(f"base_{name}", nn.Parameter(start))
            else:
                self.register_buffer(f"base_{name}", start)
        self.register_buffer("observed", torch.ones_like(maps.spacing), persistent=False)
        self.all_observed = True

    @property
    def config(self) -> dict[str, Any]:
        """Everything but maps and tensors that is needed to make the decoder again; plain JSON."""
        return {"layer": self.layer, "texels": len(self.maps), **asdict(self.model_config)}

    def state(self) -> dict[str, Tensor]:
        """Every stored tensor (learned ones, fitted ones, fixed noise): float32, contiguous, on the CPU."""
        tensors = dict(self.state_dict())
        if not self.all_observed:
            tensors["observed"] = self.observed
        return {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}

    def set_observed(self, observed: Tensor) -> None:
        """Say which texels cameras see, (N,) from 0 to 1. All do until this is called.

        The pose changes nothing but the offset of a texel that is not observed (`observed_residual`). The
        trainer learns such a texel from the surface terms alone.
        """
        self.observed.copy_(observed)
        self.all_observed = bool((self.observed >= 1.0).all())

    def observed_residual(self, residual: Tensor) -> Tensor:
        """A residual (N, 14) whose channels other than the offset are multiplied by `observed`."""
        if self.all_observed:
            return residual
        return torch.cat((residual[:, :3], residual[:, 3:] * self.observed[:, None]), dim=1)

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
        check_model(config, where)
        if config.get("texels") != len(maps):
            raise BadData(
                "The model does not fit its maps (number of texels).", where, "Export or train it again."
            )
        names = [field.name for field in fields(ModelConfig)]
        model_config = ModelConfig(**{name: config[name] for name in names if name in config})
        with torch.device("meta"):  # shapes only: nothing that a file asks for is allocated before it fits
            expected = {name: tuple(tensor.shape) for name, tensor in make(model_config).state_dict().items()}
        tensors = dict(tensors)
        observed = tensors.pop("observed", None)
        given = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if expected != given:
            name = sorted(expected.items() ^ given.items())[0][0]
            raise BadData(
                f"The tensor {name!r} is missing, extra or of a wrong shape.", where, "Train it again."
            )
        model = make(model_config)
        model.load_state_dict(tensors)
        if observed is not None:
            if observed.shape != model.observed.shape:
                raise BadData("The tensor 'observed' is of a wrong shape.", where, "Train it again.")
            model.set_observed(observed)
        return model

    def base_parameters(self) -> dict[str, Tensor]:
        """Free attributes by name (offset, quaternion, opacity, scale, color); empty when `base` is off."""
        if not self.model_config.base:
            return {}
        return {name: getattr(self, f"base_{name}") for name in CHANNELS}

    @classmethod
    def resolved(cls, config: ModelConfig) -> ModelConfig:
        """The settings without those that this decoder does not have."""
        return config

    @classmethod
    @abstractmethod
    def new(cls, maps: LayerMaps, config: ModelConfig, poses: int, seed: int) -> Self:
        """A decoder before training. `poses`: number of training poses. `seed`: of random weights."""

    @classmethod
    @abstractmethod
    def from_state(cls, config: dict[str, Any], maps: LayerMaps, tensors: dict[str, Tensor]) -> Self:
        """The decoder that `config` and `state` were taken from.

        Raises BadData where they do not fit the maps, or sizes are out of bounds.
        """

    @classmethod
    @abstractmethod
    def cost(cls, maps: LayerMaps, config: ModelConfig) -> DecoderCost:
        """What a decoder with these settings needs; `config.anchors` is the number of key poses."""

    @classmethod
    @abstractmethod
    def multiply_adds(cls, maps: LayerMaps, config: ModelConfig, poses: int, joints: int) -> dict[str, int]:
        """Multiply-adds of one pose by component.

        Arguments:
            poses: number of training poses. joints: number of joints that the layer is skinned with.
        """

    @classmethod
    def omitted(cls, maps: LayerMaps, config: ModelConfig) -> dict[str, str]:
        """What these settings leave out for a layer, and why."""
        return {}

    def multiply_adds_as_is(self, joints: int) -> dict[str, int]:
        """`multiply_adds` of this decoder."""
        return self.multiply_adds(self.maps, self.model_config, 0, joints)

    def warm_start(self, maps: LayerMaps, config: ModelConfig) -> Self:
        """A decoder for a new take that continues from this trained one.

        Arguments:
            maps: the layer's maps, on the device to learn on. config: settings of the new run. What belongs
                to a take (key poses, history) is sized by them.

        Raises:
            UsageProblem: the new run cannot continue what this decoder has learned.
        """
        return self.from_state(self.config, maps, self.state())

    def parameter_groups(
        self, step_sizes: Mapping[str, float]
    ) -> dict[str, tuple[float, list[nn.Parameter]]]:
        """Learned tensors by kind, each kind with Adam's step size.

        Arguments:
            step_sizes: of the base attributes by name (their own units), of "anchors" (key-pose offsets, m)
                and of "network", which is everything else.
        """
        step_sizes = {**step_sizes, **self.own_step_sizes(step_sizes)}
        groups: dict[str, tuple[float, list[nn.Parameter]]] = {}
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                kind = name.split(".")[0].removeprefix("base_")
                kind = kind if kind in step_sizes else "network"
                groups.setdefault(kind, (step_sizes[kind], []))[1].append(parameter)
        return groups

    def own_step_sizes(self, step_sizes: Mapping[str, float]) -> dict[str, float]:
        """Step sizes of parameters that only this decoder has, by the first part of their names."""
        return {}

    @property
    def key_poses(self) -> KeyPoseOffsets | None:
        """Free offsets of key poses; None for a decoder, or a layer, without them."""
        return None

    def fit_key_poses(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> Tensor:
        """Choose key poses among training poses, leaving everything else; returns which (K,)."""
        return torch.zeros(0, dtype=torch.int64)

    @abstractmethod
    def fit_input(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
        """Adapt to the training poses, each (55, 4, 4) as in `residual`, before training starts.

        `motions`: recent motion (H,) in every pose.
        """

    def fit_mean(self, poses: list[Tensor], motions: list[Tensor] | None = None) -> None:
        """Fit what unknown poses fall back to. Call once, when training is over.

        Arguments as in `fit_input`, in order of time.
        """
        return

    def keep_activations(self, keep: bool) -> None:
        """Whether networks keep their activations for the backward pass, or compute them again."""
        return

    @property
    def projects(self) -> bool:
        """Whether poses unlike the training's are projected on it before a network sees them."""
        return False

    def projected(self, local_transforms: Tensor) -> bool:
        """Whether a pose (55, 4, 4) is so unlike the training's that it is projected."""
        return False

    def linear_residual(self) -> LinearResidual | None:
        """The residual in linear form, where it has one."""
        return None

    def mean_residual_of_training(self) -> Tensor:
        """(N, 14) the residual of a pose about which nothing is known: the mean of the training, if fitted,
        with its offsets shrunk as `mean.py` says; else zero."""
        linear = self.linear_residual()
        return torch.zeros(len(self.maps), 14) if linear is None else linear.mean

    def residual_without_key_poses(self, local_transforms: Tensor, motion: Tensor | None = None) -> Tensor:
        """`residual` without what key poses add."""
        return self.residual(local_transforms, motion=motion)

    @abstractmethod
    def residual(
        self, local_transforms: Tensor, cosines: Tensor | None = None, motion: Tensor | None = None
    ) -> Tensor:
        """Pose-dependent part (N, 14); channels as in `texel_attributes.py`.

        `local_transforms` (55, 4, 4): pose without shape and root. `cosines` (N,): normal · viewing direction
        of every texel, used only with view conditioning. `motion`: `recent_motion`, None for a still pose.
        """

    def attributes(self, residual: Tensor) -> Attributes:
        """Base attributes plus a residual (N, 14), through the heads' activations.

        Raises BadData where a residual is not finite: the activations would make a limit of infinity.
        """
        require_finite("attributes", residual=residual)
        widths = [high - low for low, high in CHANNELS.values()]
        part = dict(zip(CHANNELS, self.observed_residual(residual).split(widths, dim=1), strict=True))
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

"""One optimiser step: networks once, several cameras splatted, surface terms, Adam."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.avatar.compose import Composite, compose
from stages.shared.avatar.deform import PosedGaussians, pose_layer
from stages.shared.avatar.model import LayerModel
from stages.shared.avatar.pose import FramePose, frame_pose
from stages.shared.errors import BadData
from stages.train import schedule
from stages.train.config import LossWeights, TrainConfig
from stages.train.data import StepChoice, TrainingViews, choose
from stages.train.objective import Surfaces, picture_terms, surface_terms, weighted

_ADAM_EPSILON = 1e-15  # gradients of single Gaussians are tiny; the usual 1e-8 would drown them
_SHAPE_KINDS = ("quaternion", "opacity", "scale")  # free attributes that wait for full-size pictures
_LEAVES = ("means", "covariances", "opacities", "features")


@dataclass
class StepReport:
    """Numbers of one step.

    Attributes:
        step, frame, cameras: what was seen. finite: False when the step was skipped.
        terms: unweighted losses, `total` weighted. gradient_norm: before clipping.
        seconds: "data", "network", "splat" (pictures with their losses), "surface", "optimiser".
    """

    step: int
    frame: int
    cameras: tuple[str, ...]
    finite: bool
    terms: dict[str, float]
    gradient_norm: float
    seconds: dict[str, float]


class Trainer:
    """Models, optimiser and data of one run.

    Arguments:
        config: of the run. models: name to model, inner to outer, on `device`. views: training pictures.
        device: where everything is computed.
    """

    def __init__(
        self, config: TrainConfig, models: dict[str, LayerModel], views: TrainingViews, device: torch.device
    ) -> None:
        self.config, self.models, self.views, self.device = config, models, views, device
        self.frames = views.frames(config.frame_step)
        self.cameras = views.take.training_cameras
        self.surfaces = Surfaces.of({name: model.maps for name, model in models.items()})
        self.parameters = dict(_named_parameters(models))
        self.optimizer = _adam(config, models)
        self._poses: dict[int, FramePose] = {}

    def step(self, number: int, elapsed: float) -> StepReport:
        """Learn from one frame, `elapsed` s into the run. A step that is not finite changes nothing."""
        done = schedule.progress(self.config, number, elapsed)
        weights = schedule.stage_weights(self.config, done)
        choice = choose(self.config.seed, number, self.frames, self.cameras, self.config.views_per_step)
        clock = _Clock()
        self.optimizer.zero_grad(set_to_none=True)
        try:
            terms = self._gradients(choice, weights, schedule.image_scale(self.config, done), clock)
        except BadData:  # the splatter refuses Gaussians that are not finite
            terms = {"total": math.nan}
        with clock("optimiser"):
            norm = self._gradient_norm()
            finite = math.isfinite(terms["total"]) and math.isfinite(norm)
            if finite:
                frozen = _SHAPE_KINDS if schedule.is_coarse(self.config, done) else ()
                self._update(schedule.rate_factor(self.config, done), norm, frozen)
        return StepReport(number, choice.frame, choice.cameras, finite, terms, norm, clock.seconds)

    def posed(self, frame: int) -> dict[str, PosedGaussians]:
        """All layers in the pose of a training frame."""
        pose = self._pose(frame)
        return {
            name: pose_layer(model.maps, model(pose.local_transforms), pose.transforms, pose.betas)
            for name, model in self.models.items()
        }

    def _gradients(
        self, choice: StepChoice, weights: LossWeights, scale: float, clock: _Clock
    ) -> dict[str, float]:
        """Accumulate the gradients of a step; returns its terms."""
        with clock("network"):
            posed = self.posed(choice.frame)
            composite = compose(posed)
        leaves = _detached(composite)
        sums: dict[str, float] = {}
        for camera, background in zip(choice.cameras, choice.backgrounds, strict=True):
            with clock("data"):
                view = self.views.view(choice.frame, camera, scale).to(self.device)
            with clock("splat"):
                behind = torch.from_numpy(background).to(self.device)
                terms = picture_terms(leaves, view, behind, weights, self.config.label_kind)
                share = weighted(terms, weights) / len(choice.cameras)
                share.backward()
                _add(sums, terms, share, 1.0 / len(choice.cameras))
        with clock("surface"):
            terms = surface_terms(posed, self.surfaces, weights, self.config.penetration_margin)
        with clock("network"):
            roots = [getattr(composite, name) for name in _LEAVES]
            seeds: list[Tensor | None] = [getattr(leaves, name).grad for name in _LEAVES]
            if terms:
                share = weighted(terms, weights)
                _add(sums, terms, share, 1.0)
                roots, seeds = roots + [share], seeds + [None]
            pairs = [(root, seed) for root, seed in zip(roots, seeds, strict=True) if root.requires_grad]
            torch.autograd.backward([root for root, _ in pairs], [seed for _, seed in pairs])
        return sums

    def _gradient_norm(self) -> float:
        gradients = [p.grad for p in self.parameters.values() if p.grad is not None]
        if not gradients:
            return math.nan
        return float(torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients))))

    def _update(self, rate_factor: float, norm: float, frozen: tuple[str, ...]) -> None:
        """One Adam step with clipped gradients and the rates of the schedule; `frozen` kinds stay."""
        if self.config.clip > 0 and norm > self.config.clip:
            gradients = [p.grad for p in self.parameters.values() if p.grad is not None]
            torch._foreach_mul_(gradients, self.config.clip / norm)
        for group in self.optimizer.param_groups:
            group["lr"] = 0.0 if group["kind"] in frozen else group["start_rate"] * rate_factor
        self.optimizer.step()

    def _pose(self, frame: int) -> FramePose:
        """The frame's pose on the device; computed once."""
        if frame not in self._poses:
            poses = self.views.poses[frame]
            arrays = (poses.rotations[0], poses.translation[0], poses.betas)
            rotations, translation, betas = (torch.from_numpy(array) for array in arrays)
            self._poses[frame] = frame_pose(self.views.body, rotations, translation, betas).to(self.device)
        return self._poses[frame]


class _Clock:
    """Adds up seconds by name: `with clock("data"): …`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started


def _named_parameters(models: dict[str, LayerModel]) -> Iterator[tuple[str, torch.nn.Parameter]]:
    for layer, model in models.items():
        for name, parameter in model.named_parameters():
            yield f"{layer}.{name}", parameter


def _adam(config: TrainConfig, models: dict[str, LayerModel]) -> torch.optim.Adam:
    """Adam with one group per kind of parameter."""
    groups: dict[str, list[torch.nn.Parameter]] = {}
    for name, parameter in _named_parameters(models):
        kind = name.split(".")[1]
        kind = kind.removeprefix("base_") if kind.startswith("base_") else "network"
        groups.setdefault(kind, []).append(parameter)
    return torch.optim.Adam(
        [
            {
                "params": members,
                "kind": kind,
                "lr": getattr(config.rates, kind),
                "start_rate": getattr(config.rates, kind),
            }
            for kind, members in groups.items()
        ],
        eps=_ADAM_EPSILON,
        fused=True,
    )


def _detached(composite: Composite) -> Composite:
    """The same Gaussians as leaves of a new graph: pictures are then differentiated one after the other."""
    leaves = {name: getattr(composite, name).detach().requires_grad_() for name in _LEAVES}
    return replace(composite, **leaves)


def _add(sums: dict[str, float], terms: dict[str, Tensor], total: Tensor, share: float) -> None:
    """Add weighted `total` and unweighted `terms` (times `share`) to the sums of a step."""
    for name, value in terms.items():
        sums[name] = sums.get(name, 0.0) + share * float(value.detach())
    sums["total"] = sums.get("total", 0.0) + float(total.detach())

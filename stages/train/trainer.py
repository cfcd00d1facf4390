"""One optimiser step: networks once, several cameras splatted, surface terms, Adam."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from stages.shared.avatar.compose import compose
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.deform import PosedGaussians, pose_layer, view_cosines
from stages.shared.avatar.pose import FramePose, pose_at, recent_motion
from stages.shared.capture import Camera
from stages.shared.errors import BadData
from stages.shared.losses.perceptual import Perceptual, face_box, face_centre
from stages.train import schedule
from stages.train.config import LossWeights, TrainConfig
from stages.train.distributed import ALONE, Processes
from stages.train.objective import (
    PerceptualCrops,
    SurfaceTopology,
    detach,
    give_gradients,
    observed_of,
    picture_terms,
    surface_terms,
    take_gradients,
    upstream_gradients,
    weighted,
)
from stages.train.observation import fill_unobserved, observed_texels
from stages.train.random_crop import RandomCrop
from stages.train.reporting import StepClock, StepReport
from stages.train.schedule import adam, named_parameters
from stages.train.tracking.tracker import Checkpoint, Tracker
from stages.train.tracking.warm_up import warm_up
from stages.train.views import StepChoice, TrainingViews, ViewKey, choose
from stages.train.warm_start import PretrainedLayers, motion_for

_LATER_KINDS = ("quaternion", "opacity", "scale", "color")  # free attributes that wait for full-size pictures
_EYE_NOISE = 0.1  # m, keeps colours from memorising the training cameras' directions
_OFFSETS = torch.tensor([1.0] * 3 + [0.0] * 11)


class Trainer:
    """Models, optimiser and data of one run.

    Arguments:
        config: of the run. models: name to model, inner to outer, on `device`. views: training pictures.
        device: where everything is computed. perceptual: metric of the LPIPS terms; None: without.
        template_frame: the frame that the template was taken from.
        pretrained: name to the decoder as it was, of layers that start from another training.
        processes: that share this run.
    """

    def __init__(
        self,
        config: TrainConfig,
        models: dict[str, Decoder],
        views: TrainingViews,
        device: torch.device,
        perceptual: Perceptual | None = None,
        template_frame: int = 0,
        pretrained: Mapping[str, Decoder] | None = None,
        processes: Processes = ALONE,
    ) -> None:
        if not any(model.key_poses for model in models.values()):  # nothing that could be followed
            config = replace(config, track=replace(config.track, frame_step=0))
        self.config, self.models, self.views, self.device = config, models, views, device
        self.processes = processes
        # One network pass serves all cameras of a step, unless colours depend on the viewing direction.
        self.one_pass = not any(model.model_config.view_conditioning for model in models.values())
        self.perceptual = perceptual.to(device) if perceptual is not None else None
        self.frames = views.frames(config.frame_step)
        self.cameras = views.sequence.training_cameras
        self.surfaces = SurfaceTopology.of({name: model.maps for name, model in models.items()})
        for model in models.values():
            model.keep_activations(not config.recompute)
        self.parameters = dict(named_parameters(models))
        self.optimizer = adam(config, models)
        self._poses: dict[int, FramePose] = {}
        self.key_frames = views.frames(config.track.frame_step) if config.track.frame_step else self.frames
        self.pretrained = PretrainedLayers(pretrained or {}, models, views.poses, self.pose)
        for name, model in models.items():
            if name not in self.pretrained.decoders:
                model.fit_input(*self._local_poses(self.key_frames))
        self.pretrained.place_key_poses(self.key_frames, tracked=bool(config.track.frame_step))
        near = np.abs(np.array(self.key_frames) - template_frame)
        self.tracker = (
            Tracker(
                config.track,
                models,
                views,
                self.key_frames,
                int(near.argmin()),
                self.pose,
                self.pretrained,
            )
            if config.track.frame_step
            else None
        )
        self.observe()

    def fill_unobserved(self) -> None:
        """Give texels that no picture shows the fabric of their garment. Training must not continue."""
        for name, model in self.models.items():
            if name not in self.pretrained.frozen:
                fill_unobserved(model)

    def observe(self) -> None:
        """Find the texels of garments that no training picture shows; pictures will not teach these."""
        sequence = self.views.sequence

        def cameras(frame: int) -> list[Camera]:
            return [sequence.camera(name, frame) for name in self.cameras]

        labels = (lambda frame, name: sequence.labels(name, frame)) if self.config.weights.label > 0 else None
        for name, observed in observed_texels(self.models, self.frames, cameras, self.pose, labels).items():
            if name not in self.pretrained.decoders:
                self.models[name].set_observed(observed)

    def warm_up(self, checkpoint: Checkpoint = lambda: None) -> None:
        """Learn the template's own frame, from where the garments are then tracked.

        Raises:
            Interrupted: by `checkpoint`, which is called once per step; nothing has changed then.
        """
        assert self.tracker is not None
        frame, config = self.key_frames[self.tracker.start], self.config
        with torch.no_grad():
            pretrained = {n: layer for n, layer in self.posed(frame).items() if n in self.pretrained.decoders}
        warm_up(
            self.models,
            self.views,
            frame,
            self.pose(frame),
            config.weights,
            config.label_kind,
            config.track.warm_up,
            config.views_per_step,
            config.seed,
            config.track.scale or 1.0,
            pretrained,
            checkpoint,
        )

    def finish(self) -> None:
        """Fit what needs a finished training."""
        for name, model in self.models.items():
            if name not in self.pretrained.frozen:
                model.fit_mean(*self._local_poses(self.frames))

    def step(self, number: int, elapsed: float) -> StepReport:
        """Learn from one frame, `elapsed` s into the run. A step that is not finite changes nothing."""
        done = schedule.progress(self.config, number, elapsed)
        weights = schedule.stage_weights(self.config, done)
        choice = self._choice(number)
        self.views.prefetcher.schedule(
            [*self._view_keys(number, elapsed), *self._view_keys(number + 1, elapsed)]
        )
        clock = StepClock()
        coarse = schedule.is_coarse(self.config, done)
        self.optimizer.zero_grad(set_to_none=True)
        terms = self._gradients(choice, weights, schedule.image_scale(self.config, done), coarse, clock)
        if self.processes.count > 1 and not self.one_pass:
            with clock("exchange"):
                terms = self.processes.sum_terms(terms)
                if math.isfinite(terms["total"]):
                    self.processes.sum_gradients(self.parameters.values())
        with clock("optimiser"):
            norm = self._gradient_norm()
            finite = math.isfinite(terms["total"]) and math.isfinite(norm)
            if finite:
                self._update(schedule.rate_factor(self.config, done), norm, _LATER_KINDS if coarse else ())
        return StepReport(number, choice.frame, choice.cameras, finite, terms, norm, clock.seconds)

    def posed(
        self, frame: int, offsets_only: bool = False, cosines: dict[str, Tensor] | None = None
    ) -> dict[str, PosedGaussians]:
        """All layers in the pose of a training frame.

        `offsets_only` keeps the networks from anything but offsets; `cosines` (name to (N,)) are for models
        whose colours see the viewing direction.
        """
        pose = self.pose(frame)
        posed = {}
        for name, model in self.models.items():
            cosine = cosines[name] if cosines else None
            motion = motion_for(model, self.views.poses, frame, pose)
            residual = model.residual(pose.local_transforms, cosine, motion)
            if offsets_only and name not in self.pretrained.decoders:
                residual = residual * _OFFSETS.to(residual)
            posed[name] = pose_layer(model.maps, model.attributes(residual), pose.transforms, pose.betas)
        return posed

    def _gradients(
        self, choice: StepChoice, weights: LossWeights, scale: float, coarse: bool, clock: StepClock
    ) -> dict[str, float]:
        """Accumulate the gradients of a step; returns its terms, `total` NaN where something was not finite.

        With one pass of the networks, several processes exchange the gradients of the Gaussians; from there
        on each computes the same. Else what is returned and accumulated is of this process's views.
        """
        views = self.processes.share(list(zip(choice.cameras, choice.backgrounds, strict=True)))
        groups = [views] if self.one_pass else [[view] for view in views]
        sums = {"total": 0.0}
        for group in groups:
            with clock("network"):
                posed = self.posed(choice.frame, coarse, self._cosines(choice, group[0][0] if group else ""))
                composite = compose(posed)
            detached = detach(composite)
            shares: list[Tensor] = []
            for camera, background in group:
                with clock("data"):
                    crop = self._random_crop(choice, camera)
                    view = self.views.view(choice.frame, camera, scale, crop).to(self.device)
                with clock("splat"):
                    behind = torch.from_numpy(background).to(self.device)
                    crops = self._perceptual_crops(choice.frame, view.camera)
                    try:
                        terms = picture_terms(detached, view, behind, weights, self.config.label_kind, crops)
                        loss = _sum(terms, weights, 1.0 / len(choice.cameras), sums)
                        if loss.requires_grad:
                            loss.backward()
                    except BadData:  # the splatter refuses Gaussians that are not finite
                        sums["total"] = math.nan
                        break
                if self.processes.count > 1 and self.one_pass:
                    shares.append(take_gradients(detached))
            if self.processes.count > 1 and self.one_pass:
                with clock("exchange"):
                    sums = self.processes.sum_terms(sums)
                    if math.isfinite(sums["total"]):
                        give_gradients(
                            detached,
                            self.processes.sum_in_order(
                                shares, len(choice.cameras), take_gradients(detached)
                            ),
                        )
            if not math.isfinite(sums["total"]):
                return sums
            with clock("surface"):
                margin, every = self.config.penetration_margin, self.config.penetration_every
                terms = surface_terms(posed, self.surfaces, weights, margin, every, choice.step)
                part = 1.0 if self.one_pass else 1.0 / len(choice.cameras)
                surface = _sum(terms, weights, part, sums) if terms else None
            with clock("network"):
                pairs = upstream_gradients(composite, detached, observed_of(self.models.values()))
                if surface is not None and surface.requires_grad:
                    pairs.append((surface, None))
                if pairs:
                    outputs, gradients = zip(*pairs, strict=True)
                    torch.autograd.backward(outputs, gradients)
        return sums

    def _random_crop(self, choice: StepChoice, camera: str) -> RandomCrop | None:
        """The part of a view that a step sees; None for all of it."""
        if not self.config.patch:
            return None
        return RandomCrop(self.config.patch, (self.config.seed, 5, choice.step, choice.cameras.index(camera)))

    def _choice(self, number: int) -> StepChoice:
        return choose(self.config.seed, number, self.frames, self.cameras, self.config.views_per_step)

    def _view_keys(self, number: int, elapsed: float) -> list[ViewKey]:
        """The views that this process needs in a step, `elapsed` s into the run."""
        choice = self._choice(number)
        scale = schedule.image_scale(self.config, schedule.progress(self.config, number, elapsed))
        cameras = self.processes.share(choice.cameras)
        return [(choice.frame, camera, scale, self._random_crop(choice, camera)) for camera in cameras]

    def _perceptual_crops(self, frame: int, camera: Camera) -> PerceptualCrops | None:
        """The crops that the perceptual terms compare in a view; None without the metric."""
        if self.perceptual is None:
            return None
        face = face_box(camera, face_centre(self.views.body, self.views.poses, frame))
        return PerceptualCrops(self.perceptual, self.config.perceptual_side, face)

    def _cosines(self, choice: StepChoice, camera: str) -> dict[str, Tensor] | None:
        """Slightly disturbed viewing cosines of every layer, when the models want them."""
        if self.one_pass:
            return None
        pose, place = self.pose(choice.frame), self.views.sequence.camera(camera, choice.frame).centre
        noise = np.random.default_rng([self.config.seed, 3, choice.step]).normal(0.0, _EYE_NOISE, 3)
        eye = torch.from_numpy(place + noise).float().to(self.device)
        return {
            name: view_cosines(model.maps, pose.transforms, pose.betas, eye)
            for name, model in self.models.items()
        }

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

    def _local_poses(self, frames: list[int]) -> tuple[list[Tensor], list[Tensor]]:
        """Local bone transforms and recent motion of every frame."""
        poses = [self.pose(frame) for frame in frames]
        return [pose.local_transforms for pose in poses], [p.motion for p in poses if p.motion is not None]

    def pose(self, frame: int) -> FramePose:
        """The frame's pose on the device; computed once."""
        if frame not in self._poses:
            motion = recent_motion(self.views.poses, frame, self.config.model.history)
            pose = pose_at(self.views.body, self.views.poses, frame, motion=motion)
            self._poses[frame] = pose.to(self.device)
        return self._poses[frame]


def _sum(terms: dict[str, Tensor], weights: LossWeights, share: float, sums: dict[str, float]) -> Tensor:
    """`share` of the weighted terms; notes them in the sums of the step, the total as "total"."""
    total = weighted(terms, weights) * share
    for name, value in terms.items():
        sums[name] = sums.get(name, 0.0) + share * float(value.detach())
    sums["total"] = sums.get("total", 0.0) + float(total.detach())
    return total

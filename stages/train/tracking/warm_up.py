"""Warm-up: the texels learn the appearance of the template's own frame, where the geometry is right."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch

from stages.shared.avatar.compose import compose
from stages.shared.avatar.decoders.base import Decoder
from stages.shared.avatar.deform import PosedGaussians, pose_layer
from stages.shared.avatar.pose import FramePose
from stages.train.config import LearningRates, LossWeights
from stages.train.objective import mask_gradients, observed_of, picture_terms, weighted
from stages.train.tracking.tracker import Checkpoint, Interrupted
from stages.train.views import TrainingViews

_RATES = LearningRates(offset=1e-4, quaternion=1e-2, opacity=5e-2, scale=2e-2, color=5e-2)
_RATE_END = 0.1
_ADAM_EPSILON = 1e-15


def warm_up(
    models: dict[str, Decoder],
    views: TrainingViews,
    frame: int,
    pose: FramePose,
    weights: LossWeights,
    label_kind: str,
    steps: int,
    views_per_step: int,
    seed: int,
    scale: float,
    pretrained: Mapping[str, PosedGaussians],
    checkpoint: Checkpoint = lambda: None,
) -> None:
    """Fit the base attributes of all layers to one frame, without what depends on the pose.

    Discs of projected colours are blurred and a little too large. Some dozen steps with large rates make them
    look like the frame.

    Arguments:
        weights: of the picture terms; flow and LPIPS are not used. scale: size of the pictures.
        pretrained: layers in that frame that were learned before; they stay as they are.
        checkpoint: called once per step.

    Raises:
        Interrupted: by `checkpoint`; the attributes are then as they were.
    """
    new = {name: model for name, model in models.items() if name not in pretrained}
    free = [(name, p) for model in new.values() for name, p in model.base_parameters().items()]
    if not free or steps <= 0:
        return
    groups = [{"params": [parameter], "start_rate": getattr(_RATES, name)} for name, parameter in free]
    optimizer = torch.optim.Adam(groups, lr=1.0, eps=_ADAM_EPSILON)
    weights = LossWeights(**{**vars(weights), "flow": 0.0})
    generator = np.random.default_rng([seed, 4])
    cameras = list(views.sequence.training_cameras)
    observed = observed_of(models.values())
    initial = [parameter.detach().clone() for _, parameter in free]
    for step in range(steps):
        try:
            checkpoint()
        except Interrupted:
            for (_, parameter), value in zip(free, initial, strict=True):
                parameter.data.copy_(value)
            raise
        factor = _RATE_END + (1 - _RATE_END) * 0.5 * (1 + math.cos(math.pi * step / steps))
        for group in optimizer.param_groups:
            group["lr"] = group["start_rate"] * factor
        optimizer.zero_grad(set_to_none=True)
        chosen = generator.permutation(len(cameras))[:views_per_step]
        posed = {
            name: pose_layer(
                model.maps,
                model.attributes(model.base_color.new_zeros(len(model.maps), 14)),
                pose.transforms,
                pose.betas,
            )
            for name, model in new.items()
        }
        composite = compose({name: posed[name] if name in posed else pretrained[name] for name in models})
        mask_gradients(composite, observed)
        losses = []
        for number in chosen:
            view = views.view(frame, cameras[number], scale).to(composite.means.device)
            background = torch.from_numpy(generator.random(3).astype(np.float32)).to(composite.means)
            terms = picture_terms(composite, view, background, weights, label_kind)
            losses.append(weighted(terms, weights))
        loss = torch.stack(losses).mean()
        if not loss.requires_grad:  # no picture term has a weight
            return
        loss.backward()
        gradients = [parameter.grad for _, parameter in free if parameter.grad is not None]
        if all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            optimizer.step()

"""Looking at a run while it trains: preview pictures, and a function that is called at given times."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.avatar.compose import compose
from stages.shared.layers import LABEL_COLORS, SKIN
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit
from stages.train.objective import render
from stages.train.trainer import Trainer
from stages.train.views import TrainingViews, View

_GREY = 200


def preview_views(views: TrainingViews, frames: list[int]) -> list[tuple[int, str]]:
    """A middle frame by the first training camera, the last by a held-out camera when there is one."""
    cameras = views.sequence.training_cameras
    held = [name for name in views.sequence.heldout_cameras if views.sequence.has_image(name, frames[-1])]
    return [(frames[len(frames) // 2], cameras[0]), (frames[-1], held[0] if held else cameras[-1])]


def preview(trainer: Trainer, choices: list[tuple[int, str]]) -> NDArray[np.uint8]:
    """(H, W, 3) u8: a row per view, truth | render | labels."""
    rows = []
    for frame, camera in choices:
        view = trainer.views.view(frame, camera, trainer.config.image_scale)
        with torch.no_grad():
            composite = compose(trainer.posed(frame))
            rendering = render(composite, view.camera)
        alpha = rendering.alpha.cpu()
        background = torch.full((3,), _GREY / 255.0)
        picture = rendering.color.cpu() + (1.0 - alpha)[..., None] * background
        colors = _layer_colors(composite.layers, trainer.views.layer_of_label)
        labels = rendering.labels.cpu() @ colors + (1.0 - alpha)[..., None] * background
        rows.append(np.concatenate([_truth(view), _bytes(picture), _bytes(labels)], axis=1))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=_GREY) for row in rows]
    return np.concatenate(padded, axis=0)


def _truth(view: View) -> NDArray[np.uint8]:
    inside = view.inside[..., None]
    return _bytes(view.image * inside + (1.0 - inside) * _GREY / 255.0)


def _layer_colors(layers: tuple[str, ...], layer_of_label: Mapping[int, str]) -> torch.Tensor:
    """(L, 3) 0..1: the label colour of each layer; of several labels that show it, the first."""
    first = {layer: label for label, layer in reversed(list(layer_of_label.items()))}
    return torch.tensor([LABEL_COLORS[first.get(layer, SKIN)] for layer in layers]) / 255.0


def _bytes(image: torch.Tensor) -> NDArray[np.uint8]:
    return (image.clamp(0, 1) * 255.0).round().to(torch.uint8).numpy()


@dataclass
class IntervalCallback:
    """A function called at given times of a training. Its time does not count, and it changes nothing.

    Attributes:
        minutes: of training, rising. look: takes the outfit, the due minute, and the number of steps done.
        layer_ids: of a baseline's layers; the stage fills them in.
    """

    minutes: tuple[float, ...]
    look: Callable[[Outfit, float, int], None]
    layer_ids: Mapping[str, Tensor] = field(default_factory=dict)

    def after_step(self, trainer: Trainer, step: int, before: float, elapsed: float) -> None:
        """Call the function if a time was due between `before` and `elapsed` (s of training)."""
        due = [minute for minute in self.minutes if before < 60 * minute <= elapsed]
        if due:
            with finished_outfit(trainer, self.layer_ids) as outfit:
                self.look(outfit, due[-1], step)


@contextmanager
def finished_outfit(trainer: Trainer, layer_ids: Mapping[str, Tensor]) -> Iterator[Outfit]:
    """The outfit as it would be if training ended now. Afterwards the models are as they were."""
    models = trainer.models
    buffers = {name: {k: v.clone() for k, v in model.named_buffers()} for name, model in models.items()}
    trainer.finish()
    for model in models.values():
        model.eval()
    try:
        layers = tuple(
            WornLayer(name, (), model.maps, model, layer_ids=layer_ids.get(name))
            for name, model in models.items()
        )
        yield Outfit(trainer.views.body, trainer.views.poses.betas, layers)
    finally:
        for name, model in models.items():
            model.train()
            for key, buffer in model.named_buffers():
                buffer.copy_(buffers[name][key])

"""Pictures for people: truth, render and labels of a few views, side by side."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.avatar.compose import compose
from stages.shared.layers import LABEL_COLORS, SKIN
from stages.train.data import TrainingViews, View
from stages.train.objective import render
from stages.train.trainer import Trainer

_GREY = 200


def preview_views(views: TrainingViews, frames: list[int]) -> list[tuple[int, str]]:
    """A middle frame by the first training camera, the last by a held-out camera when there is one."""
    cameras = views.footage.training_cameras
    held = [name for name in views.footage.heldout_cameras if views.footage.has_image(name, frames[-1])]
    return [(frames[len(frames) // 2], cameras[0]), (frames[-1], held[0] if held else cameras[-1])]


def preview(trainer: Trainer, choices: list[tuple[int, str]]) -> NDArray[np.uint8]:
    """(H, W, 3) u8: a row per view, truth | render | labels."""
    rows = []
    for frame, camera in choices:
        view = trainer.views.view(frame, camera, trainer.config.image_scale)
        with torch.no_grad():
            composite = compose(trainer.posed(frame))
            seen = render(composite, view.camera)
        alpha = seen.alpha.cpu()
        paper = torch.full((3,), _GREY / 255.0)
        picture = seen.color.cpu() + (1.0 - alpha)[..., None] * paper
        colors = _layer_colors(composite.layers, trainer.views.layer_of_label)
        chart = seen.labels.cpu() @ colors + (1.0 - alpha)[..., None] * paper
        rows.append(np.concatenate([_truth(view), _bytes(picture), _bytes(chart)], axis=1))
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

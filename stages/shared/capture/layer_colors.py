"""Colours of a layer's points from the images, taken only where the images show that layer."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.projection import project_colors
from stages.shared.capture.take import Take
from stages.shared.meshes.raycast import RayScene

_LEAST = 0.05  # confidence below this comes from pixels that mix layers


def has_label_images(take: Take, frame: int) -> bool:
    """Whether any training camera has a label image of the frame."""
    return any(
        take.has_image(name, frame) and take.view(name, frame).labels is not None
        for name in take.training_cameras
    )


def layer_colors(
    points: ArrayLike, normals: ArrayLike, labels: NDArray, occluder: RayScene, take: Take, frame: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours (N, 3) sRGB 0..1 and confidence (N,) of points, as `project_colors` gives them.

    With label images, only pixels well inside the point's own label count (not skin that the fit lets poke
    through cloth, nor the border of a neighbour); a point that has none is unseen: confidence 0.

    Arguments:
        points, normals: (N, 3) world. labels: (N,) the id each point should be seen as.
        occluder: all surfaces of that frame.
    """
    points, normals = np.asarray(points), np.asarray(normals)
    if not has_label_images(take, frame):
        return project_colors(points, normals, occluder, take, frame)
    colors = np.zeros((len(points), 3), np.float32)
    confidence = np.zeros(len(points), np.float32)
    for label in np.unique(labels):
        chosen = np.flatnonzero(labels == label)
        only = _OneLabel(
            **{field.name: getattr(take, field.name) for field in fields(Take)}, label=int(label)
        )
        colors[chosen], confidence[chosen] = project_colors(
            points[chosen], normals[chosen], occluder, only, frame
        )
    confidence[confidence < _LEAST] = 0
    return colors, confidence


@dataclass(frozen=True, eq=False)
class _OneLabel(Take):
    """A take in which everything but one label is masked away."""

    label: int = 0

    def mask(self, camera: str | Camera, frame: int) -> NDArray[np.uint8]:
        mask, labels = super().mask(camera, frame), self.labels(camera, frame)
        return mask if labels is None else np.where(labels == self.label, mask, 0).astype(np.uint8)

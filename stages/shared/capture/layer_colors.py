"""Colours of a layer's points from the images, taken only where the images show that layer."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    if not has_label_images(take, frame):
        return project_colors(points, normals, occluder, take, frame)
    colors, confidence = project_colors(points, normals, occluder, take, frame, labels=labels)
    confidence[confidence < _LEAST] = 0
    return colors, confidence

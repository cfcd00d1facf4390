"""Colours of a layer's points from the images, taken only where the images show that layer."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.capture.projection import project_colors, project_labels
from stages.shared.capture.take import Take
from stages.shared.meshes.raycast import RayScene

_AGREEMENT = 0.6  # share of the label votes that must be for the point's own label


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

    With label images, a point whose pixels carry another label than its own (skin that the fit lets poke through
    cloth, cloth at the border of its neighbour) counts as unseen.

    Arguments:
        points, normals: (N, 3) world. labels: (N,) the id each point should be seen as.
        occluder: all surfaces of that frame.
    """
    colors, confidence = project_colors(points, normals, occluder, take, frame)
    if has_label_images(take, frame):
        votes = project_labels(points, normals, occluder, take, frame)
        own = votes[np.arange(len(votes)), np.asarray(labels, dtype=np.int64)]
        confidence = np.where(own > _AGREEMENT * votes.sum(axis=1), confidence, 0).astype(np.float32)
    return colors, confidence

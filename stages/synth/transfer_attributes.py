"""Attributes of the mean body (shape offsets, skinning weights) transferred to geometry around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.meshes import edges
from stages.synth.bodies import ShapedBody
from stages.synth.offset_surface import border_vertices, neighbour_mean

Doubles = NDArray[np.float64]

_HAND_PARTS = ("wrist", "thumb", "index", "middle", "ring", "pinky")


def transfer_attributes(
    points: Doubles, faces: NDArray[np.int64], mean: ShapedBody, values: Doubles
) -> Doubles:
    """(V, K) values of the body at garment points: inverse distance over 24 vertices, then diffused."""
    names = mean.model.joint_names
    hands = [joint for joint, name in enumerate(names) if any(part in name for part in _HAND_PARTS)]
    usable = np.flatnonzero(~np.isin(mean.weights.argmax(axis=1), hands))
    distance, nearest = cKDTree(mean.rest_vertices[usable]).query(points, k=24)
    share = 1.0 / np.maximum(distance, 1e-3) ** 2
    share /= share.sum(axis=1, keepdims=True)
    transferred = np.einsum("vk,vkc->vc", share, values[usable[nearest]])
    all_edges = edges(faces)
    average = neighbour_mean(len(points), all_edges)
    border = border_vertices(len(points), faces)
    along = neighbour_mean(len(points), all_edges[border[all_edges].all(axis=1)])
    for _ in range(25):
        mean_here = np.where(border[:, None], along @ transferred, average @ transferred)
        transferred = 0.5 * transferred + 0.5 * mean_here
    return transferred

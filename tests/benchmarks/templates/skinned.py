"""The template's layers moved by their bones alone, against what was filmed in the test takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from stages.shared.artifacts import Artifact
from stages.shared.body.kinematics import skin
from stages.shared.body.model import BodyModel
from stages.shared.body.posed import row_transforms
from stages.shared.body.poses import Poses
from stages.shared.capture import Take

_SHORTEST = 1e-4  # metres; edges shorter than this say nothing about stretch


@dataclass(frozen=True)
class SkinnedLayer:
    """A layer mesh that can be posed.

    Attributes:
        vertices: (V, 3) float64 m canonical, zero shape. faces: (F, 3). weights: (V, 55).
        directions: (V, 10, 3) m per unit of shape. edges: (E, 2) of its own surface (not tucked under).
        lengths: (E,) m at the template's frame.
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    directions: np.ndarray
    edges: np.ndarray
    lengths: np.ndarray

    @classmethod
    def load(cls, segmented: Artifact, name: str) -> SkinnedLayer:
        """From a segment-layers artifact."""
        mesh = segmented.arrays(name)
        faces, world = mesh["faces"], mesh["world_vertices"].astype(np.float64)
        own = faces[(mesh["ring"][faces] == 0).all(axis=1)]
        sides = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
        edges = np.unique(np.sort(sides, axis=1), axis=0)
        lengths = np.linalg.norm(world[edges[:, 0]] - world[edges[:, 1]], axis=1)
        kept = lengths > _SHORTEST
        arrays = (mesh[part].astype(np.float64) for part in ("vertices", "skin_weights", "shape_directions"))
        vertices, weights, directions = arrays
        return cls(vertices, faces, weights, directions, edges[kept], lengths[kept])

    def posed(self, body: BodyModel, poses: Poses, frame: int) -> np.ndarray:
        """(V, 3) m, world, in the pose of a row of `poses`."""
        betas = poses.betas.astype(np.float64)
        shaped = self.vertices + np.einsum("vbk,b->vk", self.directions, betas)
        transforms = torch.from_numpy(row_transforms(body, poses, frame))
        return skin(torch.from_numpy(shaped), torch.from_numpy(self.weights), transforms).numpy()

    def stretch(self, posed: np.ndarray) -> float:
        """Largest growth of an edge against the template's frame, for posed vertices (V, 3)."""
        if not len(self.edges):
            return 1.0
        lengths = np.linalg.norm(posed[self.edges[:, 0]] - posed[self.edges[:, 1]], axis=1)
        return float((lengths / self.lengths).max())


def largest_stretches(layers: dict[str, SkinnedLayer], body: BodyModel, take: Take) -> dict[str, float]:
    """Largest growth of an edge of each layer over all poses of a take."""
    return {
        name: max(
            layer.stretch(layer.posed(body, take.poses, frame)) for frame in range(len(take.poses.rotations))
        )
        for name, layer in layers.items()
    }


def joined(layers: dict[str, SkinnedLayer]) -> np.ndarray:
    """Faces (F, 3) of all layers as one mesh."""
    starts = np.cumsum([0, *(len(layer.vertices) for layer in layers.values())])
    return np.concatenate(
        [layer.faces + start for layer, start in zip(layers.values(), starts[:-1], strict=True)]
    )


def posed_together(
    layers: dict[str, SkinnedLayer], body: BodyModel, take: Take
) -> Callable[[int], np.ndarray]:
    """Frame -> vertices of all layers as one mesh (V, 3) m, world."""

    def posed(frame: int) -> np.ndarray:
        return np.concatenate([layer.posed(body, take.poses, frame) for layer in layers.values()])

    return posed

"""Distance of a posed garment to the true one: between surfaces, and between corresponding cloth points.

Distances of surfaces measure the shape, not whether the cloth slid along its own surface. Corresponding
points measure that: each point is bound once to the true mesh (a face and barycentric weights), and its
error is the distance to the position of this point of the true mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.shared.meshes.raycast import RayScene

Points = NDArray[np.float32]
Faces = NDArray[np.int32]
STATISTICS = ("mean", "median", "p95")


@dataclass(frozen=True, eq=False)
class Binding:
    """Which points of the true cloth a set of N points are.

    Attributes:
        bound: (N,) bool: those that lie on the true mesh at all.
        corners: (n, 3) vertices of the face of each bound point. weights: (n, 3) f32 barycentric.
    """

    bound: NDArray[np.bool_]
    corners: Faces
    weights: Points

    def places(self, vertices: Points) -> Points:
        """(n, 3) m: where the bound points are on the true mesh with vertices (V, 3)."""
        return np.einsum("nk,nkc->nc", self.weights, vertices[self.corners])


def bind(points: Points, vertices: Points, faces: Faces, reach: float) -> Binding:
    """Bind points (N, 3) to the nearest place on a mesh; those farther than `reach` m from it stay free."""
    nearest, face, weights = RayScene(vertices, faces).closest(points)
    bound = np.linalg.norm(nearest - points, axis=1) <= reach
    return Binding(bound, faces[face[bound]], weights[bound])


def material_distances(binding: Binding, points: Points, vertices: Points) -> NDArray[np.float64]:
    """(n,) m from each bound point of `points` (N, 3) to where the true cloth (V, 3) has it."""
    apart = points[binding.bound].astype(np.float64) - binding.places(vertices)
    return np.linalg.norm(apart, axis=1)


def surface_distances(
    points: Points, triangles: Faces, vertices: Points, faces: Faces
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances between a set of points and a true surface, both ways.

    Arguments:
        points: (N, 3) m. triangles: (M, 3) between those that are neighbours; there may be none.
        vertices, faces: (V, 3) m and (F, 3) of the true surface.

    Returns:
        (N,) m from each point to the true surface, and (V,) m from each true vertex to the nearest triangle
        or point.
    """
    there = RayScene(vertices, faces).distance(points).astype(np.float64)
    back, _ = cKDTree(points).query(vertices)
    if len(triangles):
        back = np.minimum(back, RayScene(points, triangles).distance(vertices))
    return there, np.asarray(back, np.float64)


def spanned_triangles(neighbours: NDArray[np.int64]) -> Faces:
    """(M, 3) triangles between texels with neighbours (N, 4) above, right, below, left; −1 where none.

    A texel with the one to its right and the one below makes a triangle; so does the one with those to its
    left and above, which closes the square.
    """
    rows = np.arange(len(neighbours))
    made = []
    for first, second in ((1, 2), (3, 0)):
        there = (neighbours[:, first] >= 0) & (neighbours[:, second] >= 0)
        made.append(np.stack([rows, neighbours[:, first], neighbours[:, second]], axis=1)[there])
    return np.concatenate(made).astype(np.int32)


def statistics(distances: NDArray[np.float64]) -> dict[str, float | None]:
    """Mean, median and 95th percentile, metres; None of nothing."""
    if not len(distances):
        return dict.fromkeys(STATISTICS)
    values = (distances.mean(), np.median(distances), np.percentile(distances, 95))
    return {name: round(float(value), 6) for name, value in zip(STATISTICS, values, strict=True)}

"""Skinning weights and shape directions of a body, as a function of space around it.

Four methods, for comparison (`FieldConfig.spread`):
    nearest   the nearest body vertex; tears at armpits.
    undiffused  K nearest vertices by inverse distance.
    inverse   K nearest vertices by inverse distance, then 6-neighbour averaging (the paper's released code).
    wide      inverse distance near the skin, and further away a diffusion whose reach grows with the
              distance from the skin; does not split skirts between the legs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stages.shared.fields.diffusion import average_neighbours, diffuse_by_distance, inverse_distance_matrix
from stages.shared.fields.voxel_field import VoxelField, node_positions

_HAND_JOINTS = range(25, 55)
_EYE_JOINTS = (23, 24)
_PELVIS, _LEFT_LEG, _RIGHT_LEG = 0, [1, 4, 7, 10], [2, 5, 8, 11]


@dataclass(frozen=True)
class FieldConfig:
    """How the field is built. Lengths in metres.

    Attributes:
        resolution: nodes along each axis of the box.
        margin: how far the box reaches beyond body and template.
        band: nodes further than this from body and template are not computed. Diffusion goes through the
            band, so it must bridge the gap between the legs.
        neighbours: K of the inverse-distance weights.
        spread: "nearest", "undiffused", "inverse" or "wide".
        iterations: 6-neighbour averaging steps of "inverse".
        reach_at_skin: smoothing length of "wide" on and under the skin.
        reach_per_distance: growth of that length per metre beyond `skin_distance`.
        skin_distance: up to this far from the skin only `reach_at_skin` smooths: tight cloth follows it.
        pelvis_bias: share of the weight on both legs that "wide" gives to the pelvis. Cloth between the legs
            hangs from the waist, and stretches less when the legs part.
        hand_reach: points nearer to a hand take its vertices' weights: fingers are thinner than voxels.
        eye_reach: the same for the eyeballs, which nothing but themselves should follow.
    """

    resolution: int = 64
    margin: float = 0.06
    band: float = 0.12
    neighbours: int = 30
    spread: str = "wide"
    iterations: int = 30
    reach_at_skin: float = 0.01
    reach_per_distance: float = 10.0
    skin_distance: float = 0.015
    pelvis_bias: float = 0.15
    hand_reach: float = 0.03
    eye_reach: float = 0.004


@dataclass(frozen=True)
class BodyField:
    """Weights over J joints and 10 shape directions at any point.

    Attributes:
        field: VoxelField of J + 30 channels (weights, then directions flattened as 3 x 10).
        joints: J.
        fine_vertices: (K, 3) hand and eye vertices, metres, same frame as the field.
        fine_values: (K, J + 30).
        fine_reach: (K,) metres, how far each of them overrides the voxels.
    """

    field: VoxelField
    joints: int
    fine_vertices: np.ndarray
    fine_values: np.ndarray
    fine_reach: np.ndarray

    def sample(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights (N, J) summing to 1 and rest-frame shape directions (N, 3, 10), m, at points (N, 3)."""
        values = self._override(points, self.field.sample(points))
        weights = np.maximum(values[:, : self.joints], 0.0)
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
        return weights, values[:, self.joints :].reshape(len(points), 3, -1)

    def weights(self, points: np.ndarray) -> np.ndarray:
        """Weights (N, J) at points (N, 3)."""
        return self.sample(points)[0]

    def _override(self, points: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Fade, within reach of hands and eyes, from voxels to inverse-distance values of their vertices."""
        if not len(self.fine_vertices):
            return values
        tree = cKDTree(self.fine_vertices)
        distance, nearest = tree.query(points, distance_upper_bound=float(self.fine_reach.max()))
        near = np.flatnonzero(np.isfinite(distance))
        near = near[distance[near] < self.fine_reach[nearest[near]]]
        if not len(near):
            return values
        matrix, distance, number = inverse_distance_matrix(tree, points[near], neighbours=20)
        share = np.clip(2.0 - 2.0 * distance / self.fine_reach[number], 0.0, 1.0)[:, None]
        values = values.copy()
        values[near] = (1.0 - share) * values[near] + share * (matrix @ self.fine_values)
        return values

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Arrays for an artifact, float32 and int32."""
        return {
            **self.field.to_arrays("field"),
            "joints": np.array([self.joints], dtype=np.int32),
            "fine.vertices": self.fine_vertices.astype(np.float32),
            "fine.values": self.fine_values.astype(np.float32),
            "fine.reach": self.fine_reach.astype(np.float32),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> BodyField:
        """The inverse of `to_arrays`."""
        return cls(
            VoxelField.from_arrays(arrays, "field"),
            int(arrays["joints"][0]),
            arrays["fine.vertices"],
            arrays["fine.values"],
            arrays["fine.reach"],
        )


def build_body_field(
    vertices: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    directions: np.ndarray,
    around: np.ndarray,
    config: FieldConfig = FieldConfig(),
) -> BodyField:
    """Spread what body vertices carry into a band of space around body and template.

    Arguments:
        vertices: (V, 3) body, metres. normals: (V, 3) outward.
        weights: (V, J). directions: (V, 3, 10) rest-frame shape directions, metres.
        around: (P, 3) further points (the template) whose surroundings must be covered, metres.
    """
    eyes, hands = _dominated(weights, _EYE_JOINTS), _dominated(weights, _HAND_JOINTS)
    values = np.concatenate([weights, directions.reshape(len(vertices), -1)], axis=1).astype(np.float64)
    band, centre, half_extent, nodes = _band(vertices, around, config)
    outer = ~eyes
    spread = _spread(nodes[band], band, vertices[outer], normals[outer], values[outer], half_extent, config)
    fine = eyes | hands
    reach = np.where(eyes, config.eye_reach, config.hand_reach)[fine]
    return BodyField(
        VoxelField.from_band(spread, band, centre, half_extent),
        weights.shape[1],
        vertices[fine].astype(np.float32),
        values[fine].astype(np.float32),
        reach.astype(np.float32),
    )


def _dominated(weights: np.ndarray, joints: range | tuple[int, ...]) -> np.ndarray:
    """(V,) bool: vertices that belong mostly to these joints (none when the body has other joints)."""
    if weights.shape[1] <= max(joints):
        return np.zeros(len(weights), dtype=bool)
    return weights[:, list(joints)].sum(axis=1) > 0.5


def _band(
    vertices: np.ndarray, around: np.ndarray, config: FieldConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Box over everything with a margin; nodes (D, H, W, 3) and which of them belong to the band."""
    everything = np.concatenate([vertices, around])
    low, high = everything.min(axis=0) - config.margin, everything.max(axis=0) + config.margin
    centre = ((low + high) / 2).astype(np.float32).astype(np.float64)
    half_extent = np.full(
        3, np.float64(np.float32((high - low).max() / 2))
    )  # a cube: equal pitch along all axes
    nodes = node_positions((config.resolution,) * 3, centre, half_extent)
    distance, _ = cKDTree(everything).query(nodes.reshape(-1, 3), distance_upper_bound=config.band)
    return np.isfinite(distance).reshape(nodes.shape[:3]), centre, half_extent, nodes


def _spread(
    nodes: np.ndarray,
    band: np.ndarray,
    vertices: np.ndarray,
    normals: np.ndarray,
    values: np.ndarray,
    half_extent: np.ndarray,
    config: FieldConfig,
) -> np.ndarray:
    """Values (M, C) at the nodes (M, 3) of the band, by the configured way."""
    neighbours = 1 if config.spread == "nearest" else config.neighbours
    matrix, distance, nearest = inverse_distance_matrix(cKDTree(vertices), nodes, neighbours)
    start = matrix @ values
    pitch = 2.0 * half_extent / (config.resolution - 1)
    if config.spread == "inverse":
        return _average_in_band(start, band, config.iterations)
    if config.spread == "wide":
        outside = np.einsum("nk,nk->n", nodes - vertices[nearest], normals[nearest]) > 0
        beyond = np.where(outside, np.maximum(distance - config.skin_distance, 0.0), 0.0)
        reach = config.reach_at_skin + config.reach_per_distance * beyond
        return bias_to_pelvis(diffuse_by_distance(start, reach, band, pitch), config.pelvis_bias)
    return start


def bias_to_pelvis(values: np.ndarray, share: float) -> np.ndarray:
    """Values (M, C) in which weights of points between the legs are partly the pelvis's.

    A point with weight a on the left and b on the right leg gives up `share` · 4ab/(a + b) of it: nothing on
    a leg, most halfway. Channels after the first J joints are left alone; sums are kept.
    """
    if values.shape[1] <= _RIGHT_LEG[-1]:
        return values
    values = values.copy()
    left, right = values[:, _LEFT_LEG].sum(axis=1), values[:, _RIGHT_LEG].sum(axis=1)
    both = np.maximum(left + right, 1e-9)
    to_pelvis = share * 4.0 * left * right / both
    values[:, _LEFT_LEG + _RIGHT_LEG] *= (1.0 - to_pelvis)[:, None]
    values[:, _PELVIS] += to_pelvis * (left + right)
    return values


def _average_in_band(values: np.ndarray, band: np.ndarray, iterations: int) -> np.ndarray:
    """6-neighbour averaging over the band; a node outside it counts as its nearest band node."""
    field = VoxelField.from_band(values, band, np.zeros(3), np.ones(3))
    smooth = average_neighbours(field.dense, iterations)
    return np.moveaxis(smooth, 0, -1)[band].astype(np.float64)

"""A hull cut down, between the views, to the thickness of the clothes that the views show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from stages.register_template.hull_grid import Grid, least_in_bins
from stages.register_template.silhouettes import Doubles, Silhouette
from stages.shared.body import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT, JOINT_INDEX, LEFT_EYE, RIGHT_EYE
from stages.shared.capture.projection import sample_bilinear
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import vertex_normals

LEGS, ARMS = (3, 4), 2  # of `PARTS`: what a skirt may surround, and what may hang beside it
# Joints whose vertices have clothes of one kind of thickness: head, trunk, arms, thighs, shanks, feet.
PARTS: tuple[tuple[str, ...], ...] = (
    ("neck", "head", "jaw"),
    ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_shoulder", "right_shoulder"),
    ("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    ("pelvis", "left_hip", "right_hip"),
    ("left_knee", "right_knee"),
    ("left_ankle", "right_ankle", "left_foot", "right_foot"),
)
# Distance from a mask's edge at which a node touches it (grid steps), number of measurements of which the
# median is taken, their reach over the body, and the weight of a normal's turn by one radian (both metres).
_TOUCHING_STEPS, _CURVES, _CURVE_SPREAD_M, _NORMAL_M = 1.5, 16, 0.05, 0.08
# With fewer cameras than this, thickness above this quantile on a part of the body, plus slack in metres, is
# taken for a ghost's.
_MANY_CAMERAS, _USUAL_SHARE, _SLACK_M = 8, 0.6, 0.02
_CLOSED_M = 0.12
_LOOSE_M = 0.06  # a skirt this far from the leg does not follow it: the masks alone show its shape
_BETWEEN_M = 0.4  # points with body this near on both sides lie between two parts of it
_LIMB_M = 0.04  # from the skin of an arm to its bone; of thicker parts the hull has the inside
_LIFT_M = 0.002  # from a node, so that a ray does not begin on the body


def parts_of(body: BodyModel) -> NDArray[np.intp]:
    """(V,) number in `PARTS` of every vertex; hands belong to the arms, eyes to the head."""
    of_joint = np.full(JOINT_COUNT, 2)
    of_joint[[LEFT_EYE, RIGHT_EYE]] = 0
    for part, names in enumerate(PARTS):
        of_joint[[JOINT_INDEX[name] for name in names]] = part
    return np.asarray(of_joint[body.skin_weights.argmax(axis=1)], np.intp)


def rounded(
    values: Doubles,
    hull: Doubles,
    grid: Grid,
    silhouettes: list[Silhouette],
    body: Doubles,
    faces: NDArray[np.integer],
    parts: NDArray[np.integer],
) -> Doubles:
    """The field cut down to the thickness of the clothes, interpolated between the views.

    Every ray through a mask's edge touches the person, most likely where it comes nearest to the body. This
    gives the thickness of the clothes along a curve around the body for each view. Between the curves a hull
    has the corners of a polygon; the thickness interpolated over the body has none. Between the legs and in a
    wide skirt nothing is cut.

    Arguments:
        values: (N,) field of the nodes, limited around the body; hull: (N,) the field of the masks alone.
        body: (V, 3) posed; parts: (V,) of `PARTS`.
    """
    inside = np.flatnonzero(values > 0)
    nodes, normals = grid.nodes()[inside], vertex_normals(body, faces).astype(np.float64)
    near = _near(nodes, body, faces, normals)
    known, thickness = _touched(grid, silhouettes, nodes, near.distance, near.vertex)
    if len(silhouettes) < _MANY_CAMERAS:
        thickness = _without_outliers(thickness, parts[known])
    features = np.concatenate([body, _NORMAL_M * normals], axis=1)
    apart, around = cKDTree(features[known]).query(features, min(_CURVES, len(known)))
    weights = np.exp(-((apart / _CURVE_SPREAD_M) ** 2) / 2) + 1e-6
    # The median: where a wrong mask or camera hides what a ray touched, it seems to touch something far away.
    allowed = _weighted_median(thickness[around], weights)
    legs = np.isin(parts, LEGS)
    room = near.room(allowed, legs)
    # A node that is nearest to a hanging arm may lie in the skirt beside it.
    beside, armless = np.flatnonzero(parts[near.vertex] == ARMS), faces[(parts[faces] != ARMS).all(axis=1)]
    if len(beside) and len(armless):
        other = _near(nodes[beside], body, armless, normals)
        room[beside] = np.maximum(room[beside], other.room(allowed, legs))
    result = values.copy()
    result[inside] = np.minimum(values[inside], np.maximum(room, -grid.pitch))
    # A skirt closes the space between the legs: what was cut there is restored as far as the masks allow.
    low = inside[legs[near.vertex]]
    result[low] = np.maximum(result[low], np.minimum(values[low], _closed(result, grid)[low]))
    enclosed = np.flatnonzero(_enclosed(result, grid) & (hull > 0))
    around = _near(grid.nodes()[enclosed], body, faces, normals)
    hollow = enclosed[legs[around.vertex] | (around.distance < 0)]
    result[hollow] = hull[hollow]
    if len(silhouettes) < _MANY_CAMERAS:
        # One wrong mask or camera of a few is enough to lose a hand: there the surface is the body's.
        beside = np.flatnonzero(cKDTree(body).query(grid.nodes(), distance_upper_bound=_LIMB_M)[0] < _LIMB_M)
        skin = _near(grid.nodes()[beside], body, faces, normals)
        result[beside] = np.maximum(result[beside], -skin.distance)
    return result


@dataclass(frozen=True, eq=False)
class _Near:
    """The nearest point of the body to each of N nodes.

    Attributes:
        distance: (N,) metres, negative inside of the body. vertex: (N,) the nearest of its face's corners.
        corners: (N, 3) and shares (N, 3): the point.
        across: (N,) metres from the node, along the normal there, to the body again.
        opposite: (N,) a vertex there.
    """

    distance: Doubles
    vertex: NDArray[np.integer]
    corners: NDArray[np.integer]
    shares: Doubles
    across: Doubles
    opposite: NDArray[np.integer]

    def room(self, allowed: Doubles, legs: NDArray[np.bool_]) -> Doubles:
        """(N,) metres by which nodes are nearer to the body than clothes may be from its vertices (V,)."""
        most = np.einsum("ns,ns->n", self.shares, allowed[self.corners])
        at_leg = legs[self.vertex]
        between = at_leg & (self.across < _BETWEEN_M) & legs[self.opposite]
        free = between | (at_leg & (most > _LOOSE_M)) | (self.distance < 0)
        return np.where(free, np.inf, most - self.distance)


def _near(nodes: Doubles, body: Doubles, faces: NDArray[np.integer], normals: Doubles) -> _Near:
    """What is nearest to nodes (N, 3) on a body (V, 3) of faces (F, 3) with vertex normals (V, 3)."""
    scene = RayScene(body, faces)
    closest, face, shares = scene.closest(nodes)
    corners, offset = faces[face], nodes - closest
    facing = np.einsum("ns,nsc->nc", shares, normals[corners])
    distance = np.linalg.norm(offset, axis=1) * np.sign(np.einsum("nc,nc->n", offset, facing))
    hits = scene.first_hits(nodes + _LIFT_M * facing, facing)
    vertex = np.take_along_axis(corners, shares.argmax(axis=1)[:, None], axis=1)[:, 0]
    across = hits.distance.astype(np.float64)
    return _Near(distance, vertex, corners, shares.astype(np.float64), across, faces[hits.face, 0])


def _without_outliers(thickness: Doubles, parts: NDArray[np.integer]) -> Doubles:
    """Thickness (K,) measured on parts (K,) of the body, with what is far more than usual there cut down.

    Where the masks of few cameras disagree by some pixels, the ray that touches a limb meets only a ghost.
    """
    result = thickness.copy()
    for part in np.unique(parts):
        rows = parts == part
        usual = np.quantile(thickness[rows], _USUAL_SHARE) + _SLACK_M
        result[rows] = np.minimum(thickness[rows], usual)
    return result


def _weighted_median(values: Doubles, weights: Doubles) -> Doubles:
    """(V,) of the rows of values (V, K): below it lies half of the row's weights (V, K)."""
    order = values.argsort(axis=1)
    below = np.take_along_axis(weights, order, axis=1).cumsum(axis=1)
    middle = (below < below[:, -1:] / 2).sum(axis=1, keepdims=True)
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, middle, axis=1), axis=1)[:, 0])


def _closed(values: Doubles, grid: Grid) -> Doubles:
    """The field after closing gaps of up to twice `_CLOSED_M`: the shape grown and shrunk by as much."""
    inside = (values > 0).reshape(grid.shape)
    steps = _CLOSED_M / grid.pitch
    grown = ndimage.distance_transform_edt(~inside) < steps
    return np.asarray((ndimage.distance_transform_edt(grown) - steps) * grid.pitch, np.float64).reshape(-1)


def _enclosed(values: Doubles, grid: Grid) -> NDArray[np.bool_]:
    """(N,) nodes outside of the shape that it surrounds in their horizontal layer, as a skirt does."""
    outside = np.zeros(grid.shape, bool)
    inside = (values > 0).reshape(grid.shape)
    for layer in range(grid.shape[1]):
        outside[:, layer] = ndimage.binary_fill_holes(inside[:, layer]) & ~inside[:, layer]
    return outside.reshape(-1)


def _touched(
    grid: Grid, silhouettes: list[Silhouette], nodes: Doubles, distance: Doubles, nearest: NDArray
) -> tuple[NDArray[np.intp], Doubles]:
    """Body vertices (K,) next to which a mask's edge touches the person, and how far from the body (K,).

    Arguments:
        nodes: (N, 3) inside the hull, with their signed distance (N,) to the body and nearest vertex (N,).
    """
    vertices, thickness = [], []
    for one in silhouettes:
        pixels, depth = one.camera.project(nodes)
        seen = np.flatnonzero(one.camera.in_view(pixels))
        from_edge = sample_bilinear(one.distance, pixels[seen])[:, 0] * depth[seen] / one.focal
        touching = seen[from_edge < _TOUCHING_STEPS * grid.pitch]
        reached = distance[touching] + from_edge[from_edge < _TOUCHING_STEPS * grid.pitch]
        first = least_in_bins(one, grid, depth, pixels[touching], reached)
        vertices.append(nearest[touching[first]])
        thickness.append(reached[first])
    return np.concatenate(vertices), np.concatenate(thickness)

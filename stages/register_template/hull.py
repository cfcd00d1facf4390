"""Visual hull: the largest shape that fits into the masks of all cameras at one frame.

Every camera gives a signed distance to its silhouette, in metres at the depth of the point. The minimum over
the cameras is a field whose zero level is the hull, exact to a fraction of a pixel and of a grid step.
"""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.register_template.hull_grid import Grid, grid_between, least_in_bins
from stages.register_template.hull_rounding import rounded
from stages.register_template.silhouettes import Doubles, Silhouette, hull_field, silhouettes_of
from stages.shared.capture.scaled_take import reduced_to
from stages.shared.capture.take import Take
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.topology import adjacency, components, keep_faces
from stages.shared.report import Report

MOST_NODES = 12_000_000
_FEWEST_CAMERAS = 3
_COARSENESS = 4
# The coarse hull: cameras, half the side of its box around the person, grid step, rounds of smoothing, and
# the pixels along the long side of the masks.
_FEWEST_ROUGH_CAMERAS, _ROUGH_HALF_SIDE_M, _ROUGH_PITCH_M, _ROUGH_SMOOTHING, _ROUGH_PIXELS = (
    2,
    1.35,
    0.025,
    4,
    512,
)
# Distance from the body that the hull may always reach, reach of what one part of the body needs over the
# parts around it, and slack on top of the need; metres.
_ALWAYS_M, _SPREAD_M, _SLACK_M = 0.04, 0.15, 0.02


def carve(
    take: Take,
    frame: int,
    body_vertices: Doubles,
    pitch: float,
    reach: float,
    report: Report,
    body_faces: NDArray[np.integer] | None = None,
    parts: NDArray[np.integer] | None = None,
) -> Mesh:
    """The hull of the masks of one frame as a closed mesh; its largest part only.

    Arguments:
        take, frame: cameras and masks; the training cameras are used.
        body_vertices: (V, 3) posed body, world, metres: where to look, and how far to go.
        pitch: metres between grid nodes. It grows when the grid would be too large.
        reach: metres; nothing farther from the body belongs to the person.
        body_faces: (F, 3); with them the hull is rounded between the views (`rounded`), without it is left
            as the masks alone give it.
        parts: (V,) number of the part of the body; between vertices of `LEGS` skirts are closed.

    Raises:
        BadData: fewer than three cameras that see the person, masks that have no volume in common.
    """
    silhouettes = silhouettes_of(take, frame, _FEWEST_CAMERAS, "a hull", report)
    low, high = body_vertices.min(axis=0) - reach, body_vertices.max(axis=0) + reach
    coarse = grid_between(low, high, pitch * _COARSENESS)
    inside = hull_field(coarse.nodes(), silhouettes, coarse.pitch) > -pitch * _COARSENESS
    if not inside.any():
        raise _no_common_volume(take, frame)
    near = coarse.nodes()[inside]
    margin = pitch * (_COARSENESS + 2)
    low, high = near.min(axis=0) - margin, near.max(axis=0) + margin
    finest = (np.prod(high - low) / MOST_NODES) ** (1 / 3)
    if finest > pitch:
        report.warn(
            f"the hull is carved at {1e3 * finest:.1f} mm, not {1e3 * pitch:.1f}: the grid would be too large"
        )
        pitch = float(finest)
    grid = grid_between(low, high, pitch)
    hull = hull_field(grid.nodes(), silhouettes, grid.pitch)
    values = _without_ghosts(hull, grid, silhouettes, body_vertices, reach)
    if body_faces is not None:
        if parts is None:
            parts = np.zeros(len(body_vertices), np.intp)
        values = rounded(values, hull, grid, silhouettes, body_vertices, body_faces, parts)
    vertices, faces, _ = igl.marching_cubes(values, grid.nodes(), *grid.shape[::-1], 0.0)
    if not len(faces):
        raise BadData(
            "The masks leave no volume at this grid step.",
            f"{take.name}, frame {frame}",
            "Use a finer preset.",
        )
    return largest_part(outward(vertices, faces))


def rough_hull(take: Take, frame: int, report: Report) -> Mesh:
    """A coarse hull of the masks, made without knowing where the person is, world, metres.

    It is carved around the point that the middles of all masks look at.

    Raises:
        BadData: fewer than two cameras that see the person, masks without a common volume.
    """
    small = reduced_to(take, _ROUGH_PIXELS)
    silhouettes = silhouettes_of(small, frame, _FEWEST_ROUGH_CAMERAS, "a body", report)
    middle = _meeting_point(silhouettes)
    steps = np.arange(-_ROUGH_HALF_SIDE_M, _ROUGH_HALF_SIDE_M + _ROUGH_PITCH_M, _ROUGH_PITCH_M)
    z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
    nodes = np.stack([x, y, z], axis=-1).reshape(-1, 3) + middle
    values = hull_field(nodes, silhouettes, _ROUGH_PITCH_M)
    edge = np.abs(nodes - middle).max(axis=1) > _ROUGH_HALF_SIDE_M - 1.5 * _ROUGH_PITCH_M
    values[edge] = -_ROUGH_PITCH_M
    vertices, faces, _ = igl.marching_cubes(values, nodes, len(steps), len(steps), len(steps), 0.0)
    if not len(faces):
        raise _no_common_volume(take, frame)
    return smooth(largest_part(outward(vertices, faces)), _ROUGH_SMOOTHING)


def _meeting_point(silhouettes: list[Silhouette]) -> Doubles:
    """The point nearest to the rays through the middles of all masks (least squares)."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for one in silhouettes:
        rows, columns = np.nonzero(one.distance[..., 0] > 0)
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
        direction = one.camera.camera_from_world[:3, :3].T @ (np.linalg.inv(one.camera.intrinsics) @ pixel)
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        matrix += across
        right += across @ one.camera.centre
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), right), np.float64)


def _no_common_volume(take: Take, frame: int) -> BadData:
    return BadData(
        "The masks of the cameras have no volume in common.",
        f"{take.name}, frame {frame}",
        "Check calibration and masks; the overlay picture shows both.",
    )


def outward(vertices: Doubles, faces: NDArray[np.integer]) -> Mesh:
    """The mesh with its faces turned so that its volume is positive."""
    corners = vertices[faces]
    volume = np.einsum("fk,fk->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    turned = faces if volume > 0 else faces[:, ::-1]
    return Mesh(vertices.astype(np.float32), turned.astype(np.int32))


def largest_part(mesh: Mesh) -> Mesh:
    """The connected part with the most vertices."""
    part = components(mesh.faces, len(mesh.vertices))
    used = np.unique(mesh.faces)
    largest = np.bincount(part[used]).argmax()
    faces, rows = keep_faces(mesh.faces, part[mesh.faces[:, 0]] == largest, len(mesh.vertices))
    return Mesh(mesh.vertices[rows], faces)


def smooth(mesh: Mesh, steps: int, forward: float = 0.5, back: float = -0.53) -> Mesh:
    """Taubin smoothing: each step draws vertices to their neighbours' mean and back, so nothing shrinks.

    (G. Taubin, A signal processing approach to fair surface design, 1995.)
    """
    neighbours = adjacency(mesh.faces, len(mesh.vertices)).astype(np.float64)
    degree = np.maximum(np.asarray(neighbours.sum(axis=1)).reshape(-1, 1), 1)
    vertices = mesh.vertices.astype(np.float64)
    for _ in range(steps):
        for share in (forward, back):
            vertices = vertices + share * (neighbours @ vertices / degree - vertices)
    return Mesh(vertices.astype(np.float32), mesh.faces)


def _without_ghosts(
    values: Doubles, grid: Grid, silhouettes: list[Silhouette], body: Doubles, reach: float
) -> Doubles:
    """The field cut down to what the masks need around each part of the body.

    With few cameras a hull has ghosts: volume inside of all masks that is not needed to explain any pixel.
    Of all hull points on a ray, the one nearest to the body explains the pixel. The largest distance of these
    points from a part of the body limits how far the hull may go around that part.
    """
    inside = np.flatnonzero(values > 0)
    nodes = grid.nodes()[inside]
    tree = cKDTree(body)
    distance, nearest = tree.query(nodes)
    needed = np.zeros(len(body))
    for one in silhouettes:
        pixels, depth = one.camera.project(nodes)
        explaining = least_in_bins(one, grid, depth, pixels, distance)
        np.maximum.at(needed, nearest[explaining], distance[explaining])
    far = np.flatnonzero(needed > _ALWAYS_M)
    allowed = np.full(len(body), _ALWAYS_M)
    for part, around in zip(far, tree.query_ball_point(body[far], _SPREAD_M), strict=True):
        allowed[around] = np.maximum(allowed[around], needed[part])
    room = np.minimum(allowed[nearest] + _SLACK_M, reach) - distance
    limited = values.copy()
    limited[inside] = np.minimum(values[inside], np.maximum(room, -grid.pitch))
    return limited

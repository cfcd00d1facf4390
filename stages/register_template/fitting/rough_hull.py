"""A coarse hull of one frame's masks, made without knowing where the person is."""

from __future__ import annotations

import igl
import numpy as np

from stages.register_template.fitting.bones import Doubles
from stages.register_template.hull import largest_part, outward, smooth
from stages.register_template.silhouettes import Silhouette, hull_field, silhouette
from stages.shared.capture import Take
from stages.shared.capture.camera import Camera
from stages.shared.errors import BadData
from stages.shared.meshes.mesh import Mesh

_FEWEST_CAMERAS = 2
_HALF_SIDE_M = 1.35  # of the box around the point where the views of the person meet
_PITCH_M = 0.025
_SMOOTHING = 4


def rough_hull(take: Take, frame: int) -> Mesh:
    """The hull of the masks around the point that the middles of all masks look at, world, metres.

    Raises:
        BadData: fewer than two cameras, an empty mask, masks without a common volume.
    """
    names = [name for name in take.training_cameras if take.has_image(name, frame)]
    if len(names) < _FEWEST_CAMERAS:
        raise BadData(
            f"{len(names)} camera sees frame {frame}; a body needs {_FEWEST_CAMERAS} or more to be found.",
            f"{take.name}, frame {frame}",
            "Give the poses of the capture, or more cameras.",
        )
    silhouettes = [silhouette(take, name, frame) for name in names]
    middle = _meeting_point(silhouettes)
    steps = np.arange(-_HALF_SIDE_M, _HALF_SIDE_M + _PITCH_M, _PITCH_M)
    z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
    nodes = np.stack([x, y, z], axis=-1).reshape(-1, 3) + middle
    values = hull_field(nodes, silhouettes, _PITCH_M)
    edge = np.abs(nodes - middle).max(axis=1) > _HALF_SIDE_M - 1.5 * _PITCH_M
    values[edge] = -_PITCH_M
    vertices, faces, _ = igl.marching_cubes(values, nodes, len(steps), len(steps), len(steps), 0.0)
    if not len(faces):
        raise BadData(
            "The masks of the cameras have no volume in common.",
            f"{take.name}, frame {frame}",
            "Check calibration and masks.",
        )
    return smooth(largest_part(outward(vertices, faces)), _SMOOTHING)


def _meeting_point(silhouettes: list[Silhouette]) -> Doubles:
    """The point nearest to the rays through the middles of all masks (least squares)."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for one in silhouettes:
        rows, columns = np.nonzero(one.distance[..., 0] > 0)
        direction = _ray(one.camera, columns.mean() + 0.5, rows.mean() + 0.5)
        across = np.eye(3) - np.outer(direction, direction)
        matrix += across
        right += across @ one.camera.centre
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), right), np.float64)


def _ray(camera: Camera, x: float, y: float) -> Doubles:
    """Unit direction in the world through a pixel."""
    inside = np.linalg.inv(camera.intrinsics) @ np.array([x, y, 1.0])
    direction = camera.camera_from_world[:3, :3].T @ inside
    return np.asarray(direction / np.linalg.norm(direction), np.float64)

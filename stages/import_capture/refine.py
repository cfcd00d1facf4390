"""Poses of cameras improved by the landmarks of the person that they film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.vision.triangulate import triangulate

Doubles = NDArray[np.float64]

_ROUNDS = 12
_OUTLIER = 2.5  # times the median error
_FEWEST_POINTS = 60


def refined_cameras(cameras: Sequence[Camera], pixels: Doubles, visibility: Doubles) -> list[Camera]:
    """The cameras with poses that make the landmarks agree.

    Points and poses are improved in turns. The landmarks say nothing about where the whole rig stands and how
    large it is, so the centres of the cameras are brought back to where they were by a similarity. The round
    whose worst camera agrees best is taken; that may be the cameras as they came.

    Arguments:
        pixels: (C, T, L, 2). visibility: (C, T, L).
    """
    current = list(cameras)
    best, least = current, np.inf
    before = np.stack([camera.centre for camera in cameras])
    for _ in range(_ROUNDS):
        result = triangulate(current, pixels, visibility)
        worst = float(np.nanmax([np.nanmedian(error) for error in result.pixels]))
        if worst < least:
            best, least = current, worst
        moved = []
        for number, camera in enumerate(current):
            error = result.pixels[number]
            good = np.isfinite(error) & (visibility[number] > 0.5) & (result.views >= 3)
            good &= error < _OUTLIER * np.nanmedian(error)
            moved.append(_posed(camera, result.points[good], pixels[number][good]))
        current = _brought_back(moved, before)
    return best


def _posed(camera: Camera, points: Doubles, pixels: Doubles) -> Camera:
    if len(points) < _FEWEST_POINTS:
        return camera
    begin, _ = cv2.Rodrigues(camera.camera_from_world[:3, :3])
    way = camera.camera_from_world[:3, 3].reshape(3, 1).copy()
    turn, moved = cv2.solvePnPRefineLM(points, pixels, camera.intrinsics, np.zeros(4), begin, way)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.asarray(moved)[:, 0]
    return replace(camera, camera_from_world=pose)


def _brought_back(cameras: list[Camera], centres: Doubles) -> list[Camera]:
    """The cameras after the similarity that takes their centres nearest to `centres` (S. Umeyama, 1991)."""
    now = np.stack([camera.centre for camera in cameras])
    middle, target = now.mean(axis=0), centres.mean(axis=0)
    left, values, right = np.linalg.svd((centres - target).T @ (now - middle))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    scale = float((values * np.diag(sign)).sum() / ((now - middle) ** 2).sum())
    result = []
    for camera in cameras:
        pose = camera.camera_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        centre = scale * turn @ (camera.centre - middle) + target
        pose[:3, 3] = -pose[:3, :3] @ centre
        result.append(replace(camera, camera_from_world=pose))
    return result

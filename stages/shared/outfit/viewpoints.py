"""Cameras for pictures of an avatar: one that stands still, one that walks around; framed on the motion."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.body import BodyModel, Poses, posed_joints, rotation_matrices
from stages.shared.body.posed import pose_tensors
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem

KINDS = ("static", "orbit")
_FIELD_OF_VIEW = np.deg2rad(30.0)  # of the longer side
_MARGIN = 0.2  # metres of body, hair and cloth beyond the joints
_TILT = 0.08  # metres above the middle per metre of distance
_CHUNK = 2048


def viewpoint_cameras(
    kind: str,
    body: BodyModel,
    poses: Poses,
    betas: NDArray[np.float32],
    size: tuple[int, int],
    turns: float = 1.0,
) -> list[Camera]:
    """One camera per frame of `poses`.

    "static" stands before the body as it faces in the first frame and sees the whole motion; "orbit" follows
    the pelvis and walks around it, `turns` times over the sequence.

    Arguments:
        betas: (10,) shape of the person. size: width, height in pixels.
    """
    if kind not in KINDS:
        raise UsageProblem(
            f"There is no camera path called {kind!r}.",
            "option --camera",
            "Choose " + " or ".join(KINDS) + ".",
        )
    joints = _joints(body, poses, betas)
    facing = _facing(poses)
    count = len(joints)
    if kind == "static":
        middle, half = _box(joints.reshape(-1, 3), facing)
        camera = look_at_camera("static", middle, facing, half, size)
        return [camera] * count
    pelvis = _smooth(joints[:, 0], window=max(3, int(poses.fps)))
    relative = joints - pelvis[:, None]
    centre, half = _box(relative.reshape(-1, 3), None)
    angles = facing + 2 * np.pi * turns * np.arange(count) / max(count, 1)
    return [
        look_at_camera("orbit", place + [0, centre[1], 0], angle, half, size)
        for place, angle in zip(pelvis, angles, strict=True)
    ]


def look_at_camera(
    name: str,
    target: NDArray[np.float64],
    azimuth: float,
    half: tuple[float, float, float],
    size: tuple[int, int],
    tilt: float = _TILT,
) -> Camera:
    """A camera that sees a box of half width, half height and half depth `half` (m) around `target` (3,) m.

    Arguments:
        azimuth: radians from +z towards +x: where the camera stands. size: width, height in pixels.
        tilt: metres above the target (below, if negative) per metre of horizontal distance.
    """
    width, height = size
    focal = 0.5 * max(width, height) / np.tan(_FIELD_OF_VIEW / 2)
    # The near side of the box must fit as well.
    distance = max(half[0] * focal / (width / 2), half[1] * focal / (height / 2)) + half[2]
    away = np.array([np.sin(azimuth), tilt, np.cos(azimuth)])
    centre = np.asarray(target) + distance * away
    forward = (np.asarray(target) - centre) / np.linalg.norm(np.asarray(target) - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = -rotation @ centre
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(name, width, height, intrinsics, camera_from_world)


def _joints(body: BodyModel, poses: Poses, betas: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T, 55, 3) m, world."""
    parts: Iterable[NDArray] = [
        posed_joints(body, *pose_tensors(poses, slice(start, start + _CHUNK), betas)).numpy()
        for start in range(0, len(poses), _CHUNK)
    ]
    return np.concatenate(list(parts)).astype(np.float64)


def _facing(poses: Poses) -> float:
    """Azimuth (rad, from +z towards +x) to which the body faces in the first frame."""
    forward = rotation_matrices(torch.from_numpy(poses.rotations[0, 0]))[:, 2].numpy()
    return float(np.arctan2(forward[0], forward[2]))


def _box(
    points: NDArray[np.float64], facing: float | None
) -> tuple[NDArray[np.float64], tuple[float, float, float]]:
    """Middle (3,) and half width, height and depth of a box around points, with a margin.

    Width and depth are those seen from `facing`, or the largest from anywhere when it is None.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    half_height = float(high[1] - low[1]) / 2 + _MARGIN
    if facing is None:
        reach = float(np.linalg.norm(points[:, [0, 2]], axis=1).max()) + _MARGIN
        return middle, (reach, half_height, reach)
    across = (points - middle) @ np.array([np.cos(facing), 0, -np.sin(facing)])
    along = (points - middle) @ np.array([np.sin(facing), 0, np.cos(facing)])
    half_width, half_depth = (float(np.abs(side).max()) + _MARGIN for side in (across, along))
    return middle, (half_width, half_height, half_depth)


def _smooth(path: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Moving average over time of (T, 3), with the ends repeated."""
    window = min(window, len(path)) | 1
    padded = np.pad(path, ((window // 2, window // 2), (0, 0)), mode="edge")
    kernel = np.full(window, 1 / window)
    return np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in range(3)], axis=1)

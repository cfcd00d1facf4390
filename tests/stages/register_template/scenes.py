"""A person without clothes, seen by cameras, as a native capture; pictures come from ray casting."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.register_template.fitting.bones import State, bones_of
from stages.register_template.fitting.landmark_terms import landmark_points
from stages.shared.body import Poses, embedded_body
from stages.shared.body.posed import posed_body
from stages.shared.capture import Camera, native_writer
from stages.shared.capture.landmarks import Landmarks
from stages.shared.meshes.raycast import RayScene

_COLORS = ([200, 150, 120], [200, 40, 40])  # skin, cloth


def a_pose(frames: int = 3) -> Poses:
    """Arms go from hanging close to the body to 45° away; frame 1 is the most open one; legs stay apart."""
    rotations = np.zeros((frames, 55, 3))
    for frame, down in enumerate((1.45, 0.7, 1.3, 1.4)[:frames]):
        rotations[frame, 16, 2], rotations[frame, 17, 2] = -down, down
        rotations[frame, 1, 2], rotations[frame, 2, 2] = 0.15, -0.15
    translation = np.tile([0.0, 1.0, 0.0], (frames, 1))
    return Poses(rotations, translation, np.r_[0.5, -0.8, np.zeros(8)], np.zeros((frames, 10)), 30.0)


def ring(count: int = 6, side: int = 160) -> list[Camera]:
    """Cameras 3 m around a standing person, at changing heights."""
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        height = 0.4 if index % 2 else -0.1
        back = np.array([np.sin(angle) * np.cos(height), np.sin(height), np.cos(angle) * np.cos(height)])
        right = np.array([np.cos(angle), 0.0, -np.sin(angle)])
        rotation = np.stack([right, -np.cross(back, right), -back])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = rotation
        camera_from_world[:3, 3] = -rotation @ (np.array([0.0, 0.95, 0.0]) + 3.0 * back)
        intrinsics = np.array([[1.3 * side, 0, side / 2], [0, 1.3 * side, side / 2], [0, 0, 1.0]])
        cameras.append(Camera(f"cam{index}", side, side, intrinsics, camera_from_world))
    return cameras


def write_capture(path: Path, poses: Poses | None = None, shown: Poses | None = None) -> Path:
    """A native capture of the embedded body posed as `shown`, red on the left and blue on the right."""
    body = embedded_body()
    shown = a_pose() if shown is None else shown
    given = a_pose() if poses is None else poses
    cameras = ring()
    with native_writer(path, cameras, heldout=[]) as writer:
        take = writer.take("walk", "train", given)
        for frame in range(len(given)):
            vertices = posed_body(body, shown[frame])
            scene = RayScene(vertices, body.faces)
            colors = np.where(vertices[:, :1] > 0, [[220, 30, 30]], [[30, 30, 220]])
            for camera in cameras:
                hits = scene.render(camera)
                image = hits.interpolate(body.faces, colors).astype(np.uint8)
                take.view(camera.name, frame, image, np.where(hits.hit, 255, 0).astype(np.uint8), jpeg=False)
    return path


def skirted_pose(arms_down: tuple[float, ...]) -> Poses:
    """A frame for each angle of the arms (radians, 1.45: hanging), legs together."""
    rotations = np.zeros((len(arms_down), 55, 3))
    rotations[:, 0, 1] = 0.4
    rotations[:, 16, 2], rotations[:, 17, 2] = -np.array(arms_down), np.array(arms_down)
    rotations[:, 1, 2], rotations[:, 2, 2] = 0.03, -0.03
    betas = np.r_[0.8, -1.0, 0.5, -0.5, np.zeros(6)]
    translation = np.tile([0.0, 1.0, 0.0], (len(arms_down), 1))
    return Poses(rotations, translation, betas, np.zeros((len(arms_down), 10)), 30.0)


def write_skirted(path: Path, poses: Poses) -> Path:
    """A native capture of a body in a skirt down to its ankles, with landmarks and without poses."""
    body, cameras, random = embedded_body(), ring(8, 256), np.random.default_rng(0)
    numbers, points, _ = landmark_points(body)
    seen = np.full((len(poses), 33, 3), np.nan)
    with native_writer(path, cameras) as writer:
        take = writer.take("stand", "train", None)
        for frame in range(len(poses)):
            vertices = posed_body(body, poses[frame])
            surface, triangles = skirted_surface(vertices)
            colors = np.where(
                np.arange(len(surface))[:, None] < len(vertices), [200, 150, 120], [200, 40, 40]
            )
            scene = RayScene(surface, triangles)
            for camera in cameras:
                hits = scene.render(camera)
                image = hits.interpolate(triangles, colors).astype(np.uint8)
                take.view(camera.name, frame, image, np.where(hits.hit, 255, 0).astype(np.uint8), jpeg=False)
            truth = bones_of(body, State.of(poses[frame])).positions(points)
            seen[frame, numbers] = truth + random.normal(0, 0.015, truth.shape)
        views, frames = (len(cameras), len(poses)), np.arange(len(poses))
        landmarks = Landmarks(
            tuple(camera.name for camera in cameras),
            frames,
            np.zeros((*views, 33, 2), np.float32),
            np.ones((*views, 33), np.float32),
            seen.astype(np.float32),
            np.full((len(poses), 33), len(cameras), np.int32),
        )
        take.extra("landmarks.npz", landmarks.encoded())
    return path


def skirted_surface(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a posed body (V, 3) and its skirt."""
    cloth, faces = _skirt(vertices)
    together = np.concatenate([embedded_body().faces, faces + len(vertices)])
    return np.concatenate([vertices, cloth]), together


def _skirt(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed cone from the waist to above the ankles of a posed body: vertices and faces."""
    pelvis = vertices[embedded_body().skin_weights.argmax(axis=1) == 0]
    middle, narrow, around = pelvis.mean(axis=0), np.ptp(pelvis[:, 0]) / 2 + 0.01, 48
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    heights = np.linspace(middle[1] + 0.08, vertices[:, 1].min() + 0.12, 12)
    widths = narrow + (0.26 - narrow) * np.minimum(1, 1.2 * np.linspace(0, 1, 12))
    rings = [
        np.stack(
            [middle[0] + wide * np.cos(angle), np.full(around, high), middle[2] + wide * np.sin(angle)], 1
        )
        for high, wide in zip(heights, widths, strict=True)
    ]
    ends = [[middle[0], heights[0], middle[2]], [middle[0], heights[-1], middle[2]]]
    one = np.arange(around)
    other, faces = (one + 1) % around, []
    for row in range(0, 11 * around, around):
        faces += [np.stack([row + one, row + other, row + around + one], 1)]
        faces += [np.stack([row + other, row + around + other, row + around + one], 1)]
    top, bottom = 12 * around, 12 * around + 1
    faces += [np.stack([np.full(around, top), other, one], 1)]
    faces += [np.stack([np.full(around, bottom), 11 * around + one, 11 * around + other], 1)]
    return np.concatenate([*rings, ends]), np.concatenate(faces)

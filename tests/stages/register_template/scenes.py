"""A person without clothes, seen by cameras, as a native capture; pictures come from ray casting."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.shared.body import Poses, embedded_body
from stages.shared.body.posed import posed_body
from stages.shared.capture import Camera, native_writer
from stages.shared.meshes.raycast import RayScene


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

"""A dressed body whose truth is known: the embedded body, clothes lifted off its skin, labels, colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save

from stages.shared.body.kinematics import posed_vertices
from stages.shared.body.load import embedded_body
from stages.shared.body.poses import Poses
from stages.shared.capture import Camera, native_writer
from stages.shared.meshes.mesh import Mesh
from stages.shared.meshes.ply import encode_ply
from stages.shared.meshes.raycast import RayScene
from stages.shared.meshes.topology import vertex_normals

UPPER, LOWER, HAIR, SHOE, SKIN = 3, 4, 1, 2, 0
COLORS = np.array([[200, 150, 120], [60, 40, 20], [240, 240, 240], [200, 40, 40], [40, 60, 200]])
_LIFT = 0.012  # metres between skin and cloth


@dataclass(frozen=True)
class Dressed:
    """One frame of a dressed body: surface, pose, labels (V,)."""

    mesh: Mesh
    poses: Poses


def dressed(seed: int = 0) -> Dressed:
    """A body of random shape in a relaxed A-pose, in T-shirt, trousers, hair and shoes."""
    body, generator = embedded_body(), np.random.default_rng(seed)
    rotations = 0.05 * generator.normal(size=(1, 55, 3))
    rotations[0, 16, 2], rotations[0, 17, 2] = -0.8, 0.8
    rotations[0, 1, 2], rotations[0, 2, 2] = 0.12, -0.12
    rotations[0, 0] = [0.0, 0.3, 0.0]
    poses = Poses(rotations, np.array([[0.1, 1.0, -0.2]]), generator.normal(size=10), np.zeros((1, 10)))
    double = [torch.as_tensor(values, dtype=torch.float64) for values in (rotations[0], poses.translation[0])]
    posed = posed_vertices(body, *double, torch.as_tensor(poses.betas, dtype=torch.float64)).numpy()
    labels = body_labels()
    lift = np.where(np.isin(labels, (UPPER, LOWER)), _LIFT, 0.004 * (labels != SKIN))
    vertices = posed + lift[:, None] * vertex_normals(posed, body.faces)
    colors = COLORS[labels].astype(np.uint8)
    return Dressed(Mesh(vertices, body.faces, colors, labels.astype(np.uint8)), poses)


def body_labels() -> np.ndarray:
    """(V,) what each vertex of the embedded body wears, by rest position and dominant joint."""
    body = embedded_body()
    joint = body.skin_weights.argmax(axis=1)
    height, depth = body.template_vertices[:, 1], body.template_vertices[:, 2]
    labels = np.full(len(joint), SKIN)
    labels[np.isin(joint, (3, 6, 9, 13, 14, 16, 17))] = UPPER
    labels[np.isin(joint, (0, 1, 2, 4, 5))] = LOWER
    labels[np.isin(joint, (7, 8, 10, 11))] = SHOE
    head = joint == 15
    top = height > np.quantile(height[head], 0.6)
    labels[head & top & (depth < np.median(depth[head]))] = HAIR
    return labels


def write_capture(
    folder: Path, subject: Dressed, cameras: int = 6, size: int = 200, test: bool = False
) -> Path:
    """A native capture of that one frame (and the same pose again as frame 1), with its scan.

    With `test`, there is a test take too, which shows the same frame once more.
    """
    ring = [_camera(index, cameras, size, subject.mesh.vertices.mean(axis=0)) for index in range(cameras)]
    scene, mesh = RayScene(subject.mesh.vertices, subject.mesh.faces), subject.mesh
    assert mesh.colors is not None and mesh.labels is not None
    with native_writer(folder, ring) as writer:
        writer.body_model(save(embedded_body().to_arrays()), ".safetensors")
        take = writer.take("walk", "train", subject.poses[[0, 0]])
        take.scan(encode_ply(mesh))
        shown = [(take, 0), (take, 1)]
        if test:
            shown.append((writer.take("again", "test", subject.poses[[0]]), 0))
        for camera in ring:
            hits = scene.render(camera)
            image = np.rint(hits.interpolate(mesh.faces, mesh.colors)).astype(np.uint8)
            labels = hits.largest_corner(mesh.faces, mesh.labels, 255)
            mask = np.where(hits.hit, 255, 0).astype(np.uint8)
            for part, frame in shown:
                part.view(camera.name, frame, image, mask, labels, jpeg=False)
    return folder


def _camera(index: int, count: int, size: int, target: np.ndarray) -> Camera:
    angle = 2 * np.pi * index / count
    centre = target + 3.0 * np.array([np.sin(angle), 0.15, np.cos(angle)])
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ centre
    intrinsics = np.array([[1.45 * size, 0, size / 2], [0, 1.45 * size, size / 2], [0, 0, 1]])
    return Camera(f"cam{index}", size, size, intrinsics, camera_from_world)

"""A bare body in its rest pose before three cameras, as a capture: for tests of whole commands."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import torch

from stages.shared.body import embedded_body, posed_vertices
from stages.shared.body.poses import Poses
from stages.shared.capture import native_writer, open_capture
from stages.shared.meshes import RayScene
from tests.shared.capture import scene

SIDE = 160  # pixels
FRAMES = 2


def rest_poses(shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Poses:
    """The rest pose, feet on the floor."""
    height = -float(embedded_body().template_vertices[:, 1].min())
    translation = np.full((FRAMES, 3), [0, height, 0]) + np.array(shift)
    return Poses(np.zeros((FRAMES, 55, 3)), translation, np.zeros(10), np.zeros((FRAMES, 10)))


def rest_vertices() -> np.ndarray:
    """(V, 3) of that body, world."""
    poses = rest_poses()
    parts = (poses.rotations[0], poses.translation[0], poses.betas)
    return posed_vertices(embedded_body(), *(torch.from_numpy(part) for part in parts)).numpy()


def write_person(path: Path) -> Path:
    """A native capture: grey body, all skin."""
    rays = RayScene(rest_vertices(), embedded_body().faces)
    cameras = scene.ring(3, width=SIDE, height=SIDE, focal=130.0)
    with native_writer(path, cameras) as writer:
        take = writer.take("walk", "train", rest_poses())
        for camera in cameras:
            hit = rays.render(camera).hit
            labels = np.where(hit, 0, 255).astype(np.uint8)
            image = np.where(hit[..., None], np.uint8(150), np.uint8(0)).repeat(3, axis=2)
            for frame in range(FRAMES):
                take.view(camera.name, frame, image, hit * np.uint8(255), labels)
    return path


def write_4d_dress_person(native: Path, path: Path) -> Path:
    """The same as a take of 4D-DRESS with a scan, its camera matrices written as PyTorch3D has them."""
    source = open_capture(native).takes[0]
    folder = path / "Take3"

    def dump(name: str, value: object) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(pickle.dumps(value, protocol=4))

    cameras = {}
    for name, camera in source.cameras.items():
        turned = np.diag([-1.0, -1.0, 1.0]) @ camera.camera_from_world[:3]
        cameras[name] = {"intrinsics": camera.intrinsics, "extrinsics": turned}
        for frame in source.frames:
            place = folder / "Capture" / name
            scene.write_png(place / "images" / f"capture-f{frame + 21:05d}.png", source.image(name, frame))
            scene.write_png(place / "masks" / f"mask-f{frame + 21:05d}.png", source.mask(name, frame))
    dump("Capture/cameras.pkl", cameras)
    arrays = source.poses.to_arrays()
    for frame in source.frames:
        fit = {key: arrays[key][frame] for key in scene.FIT if key != "betas"}
        dump(f"SMPLX/mesh-f{frame + 21:05d}_smplx.pkl", {**fit, "betas": arrays["betas"][0]})
    vertices = rest_vertices()
    content = {
        "vertices": vertices,
        "faces": embedded_body().faces,
        "colors": np.full((len(vertices), 4), 150, np.uint8),
    }
    dump("Meshes_pkl/mesh-f00021.pkl", content)
    dump("Semantic/labels/label-f00021.pkl", {"scan_labels": np.where(vertices[:, 1] > 1.4, 1, 0)})
    return path

"""A ball that cameras stand around; its pictures come from the formula of a sphere alone."""

from __future__ import annotations

import csv
import json
import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np

from stages.shared.body.poses import Poses
from stages.shared.capture import Camera, native_writer

RADIUS = 0.4
CENTRE = np.array([0.0, 1.0, 0.0])
FIT = (
    "betas",
    "global_orient",
    "transl",
    "body_pose",
    "jaw_pose",
    "leye_pose",
    "reye_pose",
    "expression",
) + (
    "left_hand_pose",
    "right_hand_pose",
)
LABEL_COLORS_RGB = {0: (128, 128, 128), 3: (180, 50, 50), 4: (50, 180, 50), 255: (255, 255, 255)}


def ring(count: int = 4, width: int = 64, height: int = 48, focal: float = 70.0) -> list[Camera]:
    """Cameras 2 m from the ball, level with it; their principal points are slightly shifted."""
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        back = np.array([np.sin(angle), 0.0, np.cos(angle)])  # from the ball to the camera
        rotation = np.stack([np.array([back[2], 0.0, -back[0]]), np.array([0.0, -1.0, 0.0]), -back])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = rotation
        camera_from_world[:3, 3] = -rotation @ (CENTRE + 2.0 * back)
        intrinsics = np.array([[focal, 0, width / 2 + index], [0, focal, height / 2 - index], [0, 0, 1.0]])
        cameras.append(Camera(f"cam{index}", width, height, intrinsics, camera_from_world))
    return cameras


def color_at(points: np.ndarray) -> np.ndarray:
    """(..., 3) smooth colours in 0..1 of world points (..., 3)."""
    relative = (points - CENTRE) / RADIUS
    return 0.5 + 0.4 * relative


def label_at(points: np.ndarray) -> np.ndarray:
    """Upper half 3, lower half 4."""
    return np.where(points[..., 1] > CENTRE[1], 3, 4).astype(np.uint8)


def ball_points(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays through image places (x, y) meet the ball first, and whether they do."""
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    origin = -rotation.T @ translation
    k = camera.intrinsics
    inside = np.stack(
        [(columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1], np.ones_like(columns)], axis=-1
    )
    directions = inside @ rotation
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    b = directions @ (origin - CENTRE)
    c = (origin - CENTRE) @ (origin - CENTRE) - RADIUS**2
    root = b * b - c
    distance = -b - np.sqrt(np.maximum(root, 0))
    return origin + distance[..., None] * directions, root > 0


def picture(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (H, W, 3), mask (H, W) and labels (H, W) of the ball, sampled at pixel centres."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    points, hit = ball_points(camera, columns, rows)
    image = np.where(hit[..., None], np.round(255 * np.clip(color_at(points), 0, 1)), 0).astype(np.uint8)
    return (
        image,
        np.where(hit, 255, 0).astype(np.uint8),
        np.where(hit, label_at(points), 255).astype(np.uint8),
    )


def poses(frames: int) -> Poses:
    """Small random poses, always the same."""
    random = np.random.default_rng(5)
    return Poses(
        rotations=random.normal(0, 0.1, (frames, 55, 3)),
        translation=random.normal(0, 0.1, (frames, 3)),
        betas=random.normal(0, 1, 10),
        expression=np.zeros((frames, 10)),
        fps=30.0,
    )


def write_native(path: Path, frames: int = 3, takes: tuple[str, ...] = ("walk",)) -> Path:
    """A native capture, images lossless; the last camera is held out, all takes but the first are tests."""
    cameras = ring()
    with native_writer(path, cameras, heldout=["cam3"]) as writer:
        for number, name in enumerate(takes):
            take = writer.take(name, "train" if number == 0 else "test", poses(frames))
            for camera in cameras:
                image, mask, labels = picture(camera)
                for frame in range(frames):
                    take.view(camera.name, frame, image, mask, labels, jpeg=False)
    return path


def write_png(path: Path, image: np.ndarray) -> None:
    """An RGB or single-channel picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_actorshq(path: Path, frames: int = 3) -> Path:
    """The same ball as an ActorsHQ sequence with our additions."""
    folder = path / "Sequence1" / "1x"
    folder.mkdir(parents=True)
    rows = []
    for camera in ring():
        image, mask, labels = picture(camera)
        world_from_camera = np.linalg.inv(camera.camera_from_world)
        vector = cv2.Rodrigues(world_from_camera[:3, :3])[0].ravel()
        k = camera.intrinsics
        w, h = camera.width, camera.height
        lens = [k[0, 0] / w, k[1, 1] / h, k[0, 2] / w, k[1, 2] / h]
        rows.append([camera.name, w, h, *vector, *world_from_camera[:3, 3], *lens])
        for frame in range(frames):
            # The layout has JPEG; PNG is read as well and keeps the comparison exact.
            write_png(folder / "rgbs" / camera.name / f"{camera.name}_rgb{frame:06d}.png", image)
            write_png(folder / "masks" / camera.name / f"{camera.name}_mask{frame:06d}.png", mask)
            write_png(folder / "labels" / camera.name / f"label-f{frame:06d}.png", labels)
    with (folder / "calibration.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"])
        writer.writerows(rows)
    (folder / "smpl_params.npz").write_bytes(poses(frames).to_npz_bytes())
    scene = {"num_frames": frames, "fps": 30.0, "split": "train", "heldout_cameras": ["cam3"]}
    (path / "Sequence1" / "scene.json").write_text(json.dumps(scene))
    return path


def write_animatable(path: Path, style: str, frames: int = 3) -> Path:
    """The same ball in the THuman4 or AvatarReX layout."""
    calibration = {}
    for camera in ring():
        image, mask, labels = picture(camera)
        calibration[camera.name] = {
            "K": camera.intrinsics.ravel().tolist(),
            "R": camera.camera_from_world[:3, :3].ravel().tolist(),
            "T": camera.camera_from_world[:3, 3].tolist(),
            "imgSize": [camera.width, camera.height],
        }
        images, masks, label_folder = (
            (path / "images" / camera.name, path / "masks" / camera.name, path / "labels" / camera.name)
            if style == "thuman4"
            else (path / camera.name, path / camera.name / "mask" / "pha", path / camera.name / "labels")
        )
        for frame in range(frames):
            write_png(images / f"{frame:08d}.png", image)
            write_png(masks / f"{frame:08d}.png", mask)
            write_png(label_folder / f"{frame:08d}.png", labels)
    name = "calibration.json" if style == "thuman4" else "calibration_full.json"
    (path / name).write_text(json.dumps(calibration))
    (path / "smpl_params.npz").write_bytes(poses(frames).to_npz_bytes())
    return path


def write_4d_dress(path: Path, frames: int = 3, first: int = 11, hand_columns: int = 45) -> Path:
    """The same ball as two takes of a 4D-DRESS outfit, pickles and coloured labels included."""
    sequence = poses(frames)
    for take in ("Take1", "Take2"):
        folder = path / take
        cameras = {}
        for camera in ring():
            image, mask, labels = picture(camera)
            cameras[camera.name] = {
                "intrinsics": camera.intrinsics,
                "extrinsics": camera.camera_from_world[:3],
            }
            colored = np.zeros((*labels.shape, 3), np.uint8)
            for value, color in LABEL_COLORS_RGB.items():
                colored[labels == value] = color
            for frame in range(frames):
                place = folder / "Capture" / camera.name
                write_png(place / "images" / f"capture-f{frame + first:05d}.png", image)
                write_png(place / "masks" / f"mask-f{frame + first:05d}.png", mask)
                write_png(place / "labels" / f"label-f{frame + first:05d}.png", colored)
        _dump(folder / "Capture" / "cameras.pkl", cameras)
        for frame in range(frames):
            arrays = sequence[frame].to_arrays()
            fit = {key: arrays[key][0] for key in FIT}
            for side in ("left", "right"):
                fit[f"{side}_hand_pose"] = fit[f"{side}_hand_pose"][:hand_columns]
            _dump(folder / "SMPLX" / f"mesh-f{frame + first:05d}_smplx.pkl", fit)
    vertices = np.asfortranarray(np.random.default_rng(1).normal(size=(20, 3)))
    faces = np.arange(18).reshape(6, 3)
    _dump(
        path / "Take1" / "Meshes_pkl" / f"mesh-f{first:05d}.pkl",
        {
            "vertices": vertices,
            "faces": faces,
            "colors": np.full((20, 4), 7, np.uint8),
            "uvs": np.zeros((20, 2)),
        },
    )
    _dump(
        path / "Take1" / "Semantic" / "labels" / f"label-f{first:05d}.pkl", {"scan_labels": np.arange(20) % 5}
    )
    return path


def _dump(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=4))


def copy(source: Path, target: Path) -> Path:
    """A writable copy of a capture."""
    shutil.copytree(source, target)
    return target

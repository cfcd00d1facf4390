"""A tiny subject for training tests: two tubes (a body and a shirt), three cameras, four poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE
from stages.shared.artifacts import Workspace
from stages.shared.avatar.compose import compose
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import pose_layer
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import frame_pose
from stages.shared.body import BodyModel, Poses, embedded_body
from stages.shared.capture import Camera, native_writer
from stages.shared.splat.gaussians import Rendering
from stages.train.config import PRESETS, LearningRates, TrainConfig
from stages.train.objective import render
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays

SIZE = 40
FRAMES = 4
LABEL_OF_LAYER = {"body": 0, "upper": 3, "outer": 5}  # ids of label images; skin stands for the body
TINY = replace(
    PRESETS["tiny"],
    steps=12,
    frame_step=1,
    image_scale=1.0,
    coarse_until=0.0,
    rates=LearningRates(offset=1e-3, color=0.1),
    model=ModelConfig(width=0.0625, depth=2, style=8, factor=4, anchors=3),
)


def tiny(**changes: object) -> TrainConfig:
    """The tests' configuration with some fields replaced."""
    return replace(TINY, **changes)  # type: ignore[arg-type]


def layers() -> dict[str, dict[str, np.ndarray]]:
    """Baked arrays of the two layers."""
    return {
        "body": tube_arrays(radius=0.12),
        "upper": tube_arrays(radius=0.15, low=-0.1, high=0.2, color=(0.2, 0.5, 0.9)),
    }


def poses() -> Poses:
    """Four frames of bending sideways."""
    rotations = np.zeros((FRAMES, 55, 3), np.float32)
    rotations[:, 3, 2] = np.linspace(-0.4, 0.4, FRAMES)
    return Poses(rotations, np.zeros((FRAMES, 3)), np.zeros(10), np.zeros((FRAMES, 10)))  # type: ignore[arg-type]


def cameras() -> list[Camera]:
    """Three cameras around the tubes; the third is held out."""
    found = []
    for index, angle in enumerate((0.0, 2.1, 1.0)):
        back = np.array([np.sin(angle), 0.0, np.cos(angle)])
        rotation = np.stack([[np.cos(angle), 0, -np.sin(angle)], [0, -1, 0], -back])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ (2.0 * back)
        intrinsics = np.array([[100.0, 0, SIZE / 2], [0, 100, SIZE / 2], [0, 0, 1]])
        found.append(Camera(f"cam{index}", SIZE, SIZE, intrinsics, matrix))
    return found


def make_subject(
    folder: Path,
    arrays: dict[str, dict[str, np.ndarray]] | None = None,
    pitch: float = PITCH,
    grid: int = GRID,
    body: BodyModel | None = None,
    others: dict[str, Poses] | None = None,
) -> Path:
    """Capture with rendered images and a workspace with finished earlier stages; returns the workspace.

    `arrays`: baked layers on a grid of `pitch` m; those of `layers` where there are none. `others`: further
    training takes.
    """
    body, motion = body or embedded_body(), poses()
    arrays = arrays or layers()
    truth = {
        name: StyleUNetDecoder(LayerMaps.from_arrays(name, values, pitch, CENTRE, grid), TINY.model)
        for name, values in arrays.items()
    }
    with torch.no_grad():
        for model in truth.values():
            model.base_color.copy_(-0.7 * model.base_color.flip(1))
            model.base_offset += 0.006 * model.maps.normals
    capture = folder / "capture"
    with native_writer(capture, cameras(), heldout=["cam2"]) as writer:
        for name, moves in {"moves": motion, **(others or {})}.items():
            take = writer.take(name, "train", moves)
            for frame in range(len(moves)):
                for camera in cameras():
                    image, mask, labels = _picture(truth, body, moves, frame, camera)
                    take.view(camera.name, frame, image, mask, labels, jpeg=False)
    about = {"pitch": pitch, "centre": list(CENTRE), "grid_size": grid}
    return _workspace(folder / "subject", capture, body, motion, arrays, about)


def _picture(
    truth: dict[str, StyleUNetDecoder], body: BodyModel, motion: Poses, frame: int, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen = look(truth, body, motion, frame, camera)
    mask = (seen.alpha > 0.5).numpy()
    ids = np.array([LABEL_OF_LAYER[name] for name in truth], np.uint8)[seen.labels.argmax(dim=2).numpy()]
    image = np.clip(seen.color.numpy() * 255, 0, 255).round().astype(np.uint8)
    return image, mask.astype(np.uint8) * 255, np.where(mask, ids, 255).astype(np.uint8)


def look(
    models: dict[str, StyleUNetDecoder], body: BodyModel, motion: Poses, frame: int, camera: Camera
) -> Rendering:
    """All layers in one frame."""
    one = motion[frame]
    pose = frame_pose(body, *(torch.from_numpy(a) for a in (one.rotations[0], one.translation[0], one.betas)))
    with torch.no_grad():
        posed = {
            name: pose_layer(m.maps, m(pose.local_transforms), pose.transforms, pose.betas)
            for name, m in models.items()
        }
        return render(compose(posed), camera)


def _workspace(
    root: Path,
    capture: Path,
    body: BodyModel,
    motion: Poses,
    arrays: dict[str, dict[str, np.ndarray]],
    about: dict[str, object],
) -> Path:
    workspace = Workspace(root)
    workspace.save_settings(capture=capture, capture_format="native")
    with workspace.build(REGISTER_TEMPLATE, {}, {}) as registered:
        registered.write_bytes("smpl_params.npz", motion.to_npz_bytes())
        registered.write_arrays("body", body.to_arrays())
        corner = np.eye(3, dtype=np.float32)  # too little of a surface to compare the cameras' colours by
        registered.write_arrays("template", {"vertices": corner, "faces": np.array([[0, 1, 2]], np.int32)})
        registered.summary(take="moves", frame=0)
    with workspace.build(BAKE_MAPS, {}, {"register-template": registered.artifact}) as baked:
        for name, values in arrays.items():
            baked.write_arrays(name, values)
        baked.summary(layers=list(arrays), **about)
    return root

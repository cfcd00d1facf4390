"""A tiny wardrobe for tests: tubes as body and garments, as bundles and as a finished subject."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stages.fit_cloth.mesh import build_pattern
from stages.pipeline import BAKE_MAPS, REGISTER_TEMPLATE, SEGMENT_LAYERS, TRAIN
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.bundle import Bundle
from stages.shared.avatar.config import ModelConfig
from stages.shared.avatar.decoders.styleunet import StyleUNetDecoder
from stages.shared.avatar.deform import blended, moved, shaped_positions
from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.pose import pose_at
from stages.shared.body import BodyModel, Poses, embedded_body
from stages.shared.capture import Camera, native_writer
from stages.shared.cloth.material import TIGHT, Material
from stages.shared.outfit.layer import WornLayer
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.viewpoints import look_at_camera
from tests.shared.avatar.tubes import CENTRE, GRID, PITCH, tube_arrays

MODEL = ModelConfig(width=0.0625, depth=2, style=8, factor=4)
LABEL = {"body": 0, "upper": 3, "lower": 4, "outer": 5}
SHAPES: dict[str, dict[str, Any]] = {
    "body": {"radius": 0.12},
    "lower": {"radius": 0.14, "low": -0.3, "high": -0.02, "color": (0.9, 0.2, 0.2)},
    "upper": {"radius": 0.15, "low": -0.06, "high": 0.2, "color": (0.2, 0.5, 0.9)},
    "outer": {"radius": 0.17, "low": -0.2, "high": 0.2, "color": (0.2, 0.8, 0.3)},
}
FRAMES, SIZE = 5, 48
SHIFT = 4  # grey levels by which the truth of the tiny subject differs from its render


def worn(name: str, offset: float = 0.0, source: str = "", **shape: Any) -> WornLayer:
    """A layer whose Gaussians lie `offset` m outside its maps."""
    maps = LayerMaps.from_arrays(name, tube_arrays(**{**SHAPES[name], **shape}), PITCH, CENTRE, GRID)
    model = StyleUNetDecoder(maps, MODEL).eval()
    with torch.no_grad():
        model.base_offset += offset * maps.normals
    model.requires_grad_(False)
    return WornLayer(name, () if name == "body" else (name,), maps, model, source)


def simulated(name: str, material: Material = TIGHT, source: str = "", **shape: Any) -> WornLayer:
    """A layer that is simulated by default, on a mesh of few vertices."""
    layer = worn(name, source=source, **shape)
    pose = motion()[[0]]
    cloth = build_pattern(name, world_mesh(layer), layer.maps, embedded_body(), pose, 60, material)
    return replace(layer, cloth=cloth, drive="simulated")


def world_mesh(layer: WornLayer) -> dict[str, np.ndarray]:
    """The layer's mesh with its vertices in the first pose of the motion as well."""
    pose = pose_at(embedded_body(), motion(), 0)
    matrices = blended(layer.maps.skin_weights, pose.transforms)
    placed = moved(shaped_positions(layer.maps, pose.betas), matrices)
    return {**tube_mesh(layer), "world_vertices": placed.numpy()}


@cache
def small_body() -> dict[str, np.ndarray]:
    """The embedded body's arrays that a bundle carries."""
    names = ("template_vertices", "faces", "shape_directions", "joint_regressor", "skin_weights")
    arrays = embedded_body().to_arrays()
    return {name: arrays[name] for name in names}


def bundle(layer: WornLayer, slots: tuple[str, ...] | None = None, digest: str = "ab" * 32) -> Bundle:
    """The layer as `gw export-garment` would write it."""
    arrays = {f"maps/{name}": array for name, array in layer.maps.arrays().items()}
    arrays |= {f"model/{name}": tensor.numpy() for name, tensor in layer.model.state().items()}
    arrays["betas"] = np.linspace(-1, 1, 10, dtype=np.float32)
    arrays["preview"] = np.full((8, 8, 3), 200, np.uint8)
    if layer.name == "body":
        arrays |= {f"body/{name}": array for name, array in small_body().items()}
    else:
        texels = layer.maps.texels.numpy().astype(np.int32)
        arrays["swap/texels"] = texels
        arrays["swap/offsets"] = np.full((len(texels), 3), 0.001, np.float32)
        arrays["swap/quaternions"] = np.tile(np.array([1, 0, 0, 0], np.float32), (len(texels), 1))
    if layer.cloth is not None:
        arrays |= {f"cloth/{name}": array for name, array in layer.cloth.arrays().items()}
    manifest: dict[str, Any] = {
        "kind": "body" if layer.name == "body" else "garment",
        "layer": layer.name,
        "slots": list(layer.slots if slots is None else slots),
        "body_model": {"digest": digest, "convention": "SMPL-X", "joints": 55, "betas": 10},
        "grid": {"pitch": PITCH, "centre": list(CENTRE), "size": GRID},
        "units": {},
        "frames": {},
        "model": layer.model.config,
        "training": {"source": layer.source},
        "note": "",
    }
    if layer.cloth is not None:
        manifest["cloth"] = {"material": layer.cloth.material.to_json(), "drive": layer.drive}
    return Bundle(manifest, arrays)


def outfit(*names: str) -> Outfit:
    """An outfit of tubes, inner to outer."""
    return Outfit(embedded_body(), np.zeros(10, np.float32), tuple(worn(name) for name in names))


def motion(frames: int = FRAMES) -> Poses:
    """Bending sideways."""
    rotations = np.zeros((frames, 55, 3), np.float32)
    rotations[:, 3, 2] = np.linspace(-0.4, 0.4, frames)
    zeros = np.zeros((frames, 10), np.float32)
    return Poses(rotations, np.zeros((frames, 3), np.float32), zeros[0], zeros)


def cameras() -> list[Camera]:
    """Three around the tubes; the third is held out."""
    return [
        replace(look_at_camera("", np.zeros(3), angle, (0.35, 0.4, 0.35), (SIZE, SIZE)), name=f"cam{index}")
        for index, angle in enumerate((0.0, 2.1, 1.0))
    ]


def make_subject(folder: Path, trained: bool = True) -> Path:
    """A capture that shows the trained outfit, off by `SHIFT` levels, and the finished subject."""
    dressed = outfit("body", "lower", "upper")
    capture = folder / "capture"
    with native_writer(capture, cameras(), heldout=["cam2"]) as writer:
        for name, split in (("moves", "train"), ("other", "test")):
            take = writer.take(name, split, motion())  # type: ignore[arg-type]
            for frame in range(FRAMES):
                composite = dressed.composite(motion(), frame)
                for camera in cameras():
                    shot = render_image(composite, camera)
                    picture = shot.on((0.0, 0.0, 0.0)).astype(int)
                    picture = np.where(picture < 128, picture + SHIFT, picture - SHIFT).astype(np.uint8)
                    mask = (shot.alpha > 0.5).astype(np.uint8) * 255
                    labels = np.where(mask > 0, shot.labels, 255).astype(np.uint8)
                    take.view(camera.name, frame, picture, mask, labels, jpeg=False)
    return _workspace(folder / "subject", capture, dressed, trained)


def _workspace(root: Path, capture: Path, dressed: Outfit, trained: bool) -> Path:
    workspace = Workspace(root)
    workspace.save_settings(capture=capture, capture_format="native")
    body = BodyModel.from_arrays(small_body())
    with workspace.build(REGISTER_TEMPLATE, {}, {}) as registered:
        registered.write_bytes("smpl_params.npz", motion().to_npz_bytes())
        registered.write_arrays("body", body.to_arrays())
        corner = np.eye(3, dtype=np.float32)  # too little of a surface to compare the cameras' colours by
        registered.write_arrays("template", {"vertices": corner, "faces": np.array([[0, 1, 2]], np.int32)})
        registered.summary(take="moves", frame=0)
    with workspace.build(SEGMENT_LAYERS, {}, {"register-template": registered.artifact}) as segmented:
        for layer in dressed.layers:
            segmented.write_arrays(layer.name, world_mesh(layer))
        segmented.summary(layers=list(dressed.names), frame=0)
    with workspace.build(BAKE_MAPS, {}, {"segment-layers": segmented.artifact}) as baked:
        for layer in dressed.layers:
            baked.write_arrays(layer.name, layer.maps.arrays())
        texels = {layer.name: len(layer.maps) for layer in dressed.layers}
        baked.summary(
            layers=list(dressed.names), pitch=PITCH, centre=list(CENTRE), grid_size=GRID, texels=texels
        )
    if trained:
        with workspace.build(TRAIN, {"steps": 0}, {"bake-maps": baked.artifact}) as build:
            for layer in dressed.layers:
                tensors = {name: tensor.numpy() for name, tensor in layer.model.state().items()}
                build.write_arrays(layer.name, tensors)
            build.write_json("model.json", {"layers": {la.name: la.model.config for la in dressed.layers}})
            build.summary(layers=list(dressed.names))
    return root


def tube_mesh(layer: WornLayer) -> dict[str, np.ndarray]:
    """The layer's texels as a mesh: each view's grid of texels cut into triangles."""
    arrays = layer.maps.arrays()
    right, down = arrays["neighbours"][:, 1], arrays["neighbours"][:, 2]
    start = np.flatnonzero((right >= 0) & (down >= 0))
    start = start[right[down[start]] >= 0]
    here, east, south, corner = start, right[start], down[start], right[down[start]]
    faces = np.concatenate([np.stack([here, south, east], 1), np.stack([east, south, corner], 1)])
    count = len(arrays["positions"])
    return {
        "vertices": arrays["positions"],
        "faces": faces.astype(np.int32),
        "skin_weights": arrays["skin_weights"],
        "shape_directions": arrays["shape_directions"],
        "colors": np.rint(255 * arrays["colors"]).astype(np.uint8),
        "labels": np.full(count, LABEL[layer.name], np.uint8),
    }

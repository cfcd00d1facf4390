"""The baseline without learning: meshes of the layers with projected colours, skinned and ray cast."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from stages.evaluate.views import FrameViews
from stages.shared.artifacts import Artifact
from stages.shared.avatar.deform import PosedGaussians
from stages.shared.body import BodyModel, Poses, posed_from_canonical, skin
from stages.shared.body.posed import pose_tensors
from stages.shared.capture import Take
from stages.shared.capture.camera import Box, Camera
from stages.shared.capture.exposure import Exposure
from stages.shared.layers import NO_LABEL
from stages.shared.meshes.raycast import RayScene
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.render_image import render_image


@dataclass(frozen=True, eq=False)
class Baseline:
    """All layer meshes as one.

    Attributes:
        body: bones. betas: (10,) f32 of the subject.
        vertices: (V, 3) f32 m canonical, of that shape. faces: (F, 3) i32. skin_weights: (V, 55) f32.
        colors: (V, 3) f32 sRGB 0..255. labels: (V,) u8.
    """

    body: BodyModel
    betas: NDArray[np.float32]
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    skin_weights: NDArray[np.float32]
    colors: NDArray[np.float32]
    labels: NDArray[np.uint8]

    @classmethod
    def load(cls, segmented: Artifact, body: BodyModel, betas: NDArray[np.float32]) -> Baseline:
        """From a segment-layers artifact."""
        meshes = [segmented.arrays(name) for name in segmented.summary["layers"]]
        starts = np.cumsum([0] + [len(mesh["vertices"]) for mesh in meshes])
        shaped = [
            mesh["vertices"] + np.einsum("b,vbk->vk", betas, mesh["shape_directions"]) for mesh in meshes
        ]
        return cls(
            body,
            betas,
            np.concatenate(shaped).astype(np.float32),
            np.concatenate([mesh["faces"] + start for mesh, start in zip(meshes, starts[:-1], strict=True)]),
            np.concatenate([mesh["skin_weights"] for mesh in meshes]),
            np.concatenate([mesh["colors"] for mesh in meshes]).astype(np.float32),
            np.concatenate([mesh["labels"] for mesh in meshes]),
        )

    def posed(self, poses: Poses, frame: int) -> RayScene:
        """The surface in the pose of a row of `poses`, world, ready for rays."""
        transforms = posed_from_canonical(self.body, *pose_tensors(poses, frame, self.betas))
        moved = skin(torch.from_numpy(self.vertices), torch.from_numpy(self.skin_weights), transforms)
        return RayScene(moved.numpy(), self.faces)

    def render(
        self, scene: RayScene, camera: Camera, supersampling: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
        """Picture (H, W, 3) u8 on black, alpha (H, W) f32 and label ids (H, W) u8 of a posed surface."""
        picture = np.zeros((camera.height, camera.width, 3), np.uint8)
        alpha = np.zeros((camera.height, camera.width), np.float32)
        labels = np.full((camera.height, camera.width), NO_LABEL, np.uint8)
        box = _box_of(scene, camera)
        if box is None:
            return picture, alpha, labels
        part = np.s_[box[1] : box[3], box[0] : box[2]]
        hits = scene.render(camera.crop(box).scaled(supersampling))
        color = _averaged(hits.interpolate(self.faces, self.colors), supersampling)
        picture[part] = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        alpha[part] = _averaged(hits.hit[..., None].astype(np.float32), supersampling)[..., 0]
        middle = supersampling // 2
        ids = hits.largest_corner(self.faces, self.labels, outside=NO_LABEL)
        labels[part] = ids[middle::supersampling, middle::supersampling]
        return picture, alpha, labels


def _box_of(scene: RayScene, camera: Camera) -> Box | None:
    """The part of the image where the surface can be; None where it is out of sight."""
    pixels, depth = camera.project(scene.vertices)
    seen = pixels[depth > 0]
    if not len(seen):
        return None
    low = np.floor(seen.min(axis=0)).astype(int) - 1
    high = np.ceil(seen.max(axis=0)).astype(int) + 1
    left, top = max(0, int(low[0])), max(0, int(low[1]))
    right, bottom = min(camera.width, int(high[0])), min(camera.height, int(high[1]))
    return (left, top, right, bottom) if right > left and bottom > top else None


def _averaged(values: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Mean over blocks of factor × factor pixels: (h f, w f, C) -> (h, w, C)."""
    height, width, channels = values.shape
    blocks = values.reshape(height // factor, factor, width // factor, factor, channels)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


Rendered = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]  # picture on black, alpha, labels


class Method(Protocol):
    """Something that can show a frame to a camera."""

    def pose(self, views: FrameViews) -> None: ...

    def render(self, camera: Camera) -> Rendered: ...


class TrainedMethod:
    """The trained layers of the subject, as learned in training takes and driven in others.

    Arguments:
        outfit: the subject in its own clothes. drive: as `Outfit.driven` takes it.
        exposures: of cameras that were learned from; another camera shows the colours as they were learned.
    """

    def __init__(
        self, outfit: Outfit, drive: str = "learned", exposures: Mapping[str, Exposure] = {}
    ) -> None:
        self.outfit, self._exposures = outfit, exposures
        self._by_split = {"train": outfit.driven(drive, trained_poses=True), "test": outfit.driven(drive)}

    def pose(self, views: FrameViews) -> None:
        outfit = self._by_split[views.take.split]
        self._composite = outfit.composite(views.take.poses, views.frame)

    def posed(self, take: Take, frame: int) -> dict[str, PosedGaussians]:
        """All layers in a frame of a take."""
        return self._by_split[take.split].posed(take.poses, frame)

    def render(self, camera: Camera) -> Rendered:
        shot = render_image(self._composite, camera)
        picture, exposure = shot.on((0.0, 0.0, 0.0)), self._exposures.get(camera.name)
        if exposure is not None:
            picture = exposure.applied(picture, shot.alpha)
        return picture, shot.alpha, shot.labels


class BaselineMethod:
    """The meshes that learned nothing."""

    def __init__(self, baseline: Baseline, supersampling: int) -> None:
        self.baseline, self.supersampling = baseline, supersampling

    def pose(self, views: FrameViews) -> None:
        self._scene = self.baseline.posed(views.take.poses, views.frame)

    def render(self, camera: Camera) -> Rendered:
        return self.baseline.render(self._scene, camera, self.supersampling)

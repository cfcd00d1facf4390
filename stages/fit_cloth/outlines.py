"""How well a garment's place agrees with the label images of the take.

Rays through pixels meet the surface that the garment's texels span. A pixel is wrong where only the rays or
only the label image show the garment. What lies beneath the garment hides it: the body, and the garments that
were fitted before. Pixels of garments outside it do not count, because those are not known yet. Offsets that
training tracked cannot judge a place: where tracking was lost they stay near the bones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.shared.body import BodyModel, Poses
from stages.shared.capture import Camera, Take
from stages.shared.cloth.body_surface import BodyCollider
from stages.shared.layers import LAYER_OF_LABEL, LAYERS, NO_LABEL
from stages.shared.meshes import RayScene
from stages.shared.outfit.simulation import OutfitSimulation

MOST_FRAMES = 24
MOST_CAMERAS = 4
_SAMPLES_PER_TEXEL = 1.5  # rays across a texel, at most one per pixel
_BORDER = 0.15  # of the person's size in a picture: how far around it rays are cast
_DEPTH_TOLERANCE = 0.015  # metres by which a garment may lie inside what is beneath it

Floats = NDArray[np.float32]
Surfaces = list[tuple[NDArray, NDArray]]  # vertices (V, 3) m, world, and faces (F, 3)


@dataclass(frozen=True, eq=False)
class OutlineView:
    """Sampled pixels of one camera in one frame.

    Attributes:
        origin: (3,) and directions: (K, 3) of their rays, world.
        garment: (K,) whether the label image shows the garment.
        absent: (K,) whether it shows the background or what lies beneath the garment.
        beneath: (K,) m of depth at which the ray meets what lies beneath the garment; inf for nothing.
    """

    origin: Floats
    directions: Floats
    garment: NDArray[np.bool_]
    absent: NDArray[np.bool_]
    beneath: Floats


@dataclass(frozen=True, eq=False)
class Outlines:
    """Label images of one garment, by frame, and the (M, 3) triangles between its texels."""

    views: dict[int, list[OutlineView]]
    triangles: NDArray[np.int32]

    def disagreement(self, frame: int, places: NDArray) -> float:
        """1 − IoU of the garment at (N, 3) m, world, with the label images of a frame, over its cameras."""
        scene = RayScene(places, self.triangles)
        both = either = 0
        for view in self.views[frame]:
            depth = scene.first_hits(view.origin, view.directions).distance
            shown = np.isfinite(depth) & (depth < view.beneath + _DEPTH_TOLERANCE)
            both += int((shown & view.garment).sum())
            either += int((view.garment | (shown & view.absent)).sum())
        return 1.0 - both / either if either else 0.0


def read_outlines(
    take: Take,
    frames: list[int],
    layer: str,
    triangles: NDArray[np.int32],
    pitch: float,
    beneath: Callable[[int], Surfaces],
) -> Outlines | None:
    """Label images of a garment in the chosen frames; None where the take has none.

    Arguments:
        triangles: (M, 3) between the garment's texels. pitch: metres between them.
        beneath: frame to the surfaces that the garment is worn over.
    """
    views: dict[int, list[OutlineView]] = {}
    if not len(triangles):
        return None
    for frame in frames:
        scene: RayScene | None = None
        for name in chosen_cameras(take):
            labels = take.labels(name, frame) if take.has_image(name, frame) else None
            if labels is None or not (labels != NO_LABEL).any():
                continue
            scene = scene or RayScene.of_parts(beneath(frame))
            views.setdefault(frame, []).append(outline_view(take.camera(name), labels, layer, pitch, scene))
    return Outlines(views, triangles) if views else None


def outline_view(
    camera: Camera, labels: NDArray[np.uint8], layer: str, pitch: float, beneath: RayScene
) -> OutlineView:
    """Pixels around the person in a label image (H, W), at most `_SAMPLES_PER_TEXEL` across a texel."""
    outside = LAYERS[LAYERS.index(layer) + 1 :]
    layer_of = np.full(256, "", dtype=object)
    for label, name in LAYER_OF_LABEL.items():
        layer_of[label] = name
    known = layer_of[labels]
    person = np.argwhere(labels != NO_LABEL)
    low, high = person.min(axis=0), person.max(axis=0) + 1
    border = int(_BORDER * (high - low).max()) + 1
    low, high = np.maximum(low - border, 0), np.minimum(high + border, labels.shape)
    origin, directions = camera.rays()
    depth = float(np.linalg.norm(beneath.vertices.mean(axis=0) - origin))
    stride = max(1, int(camera.intrinsics[0, 0] * pitch / depth / _SAMPLES_PER_TEXEL))
    chosen = np.s_[low[0] : high[0] : stride, low[1] : high[1] : stride]
    sampled = np.asarray(directions[chosen], dtype=np.float32).reshape(-1, 3)
    names = known[chosen].ravel()
    return OutlineView(
        np.asarray(origin, dtype=np.float32),
        sampled,
        np.asarray(names == layer),
        np.asarray(~np.isin(names, [layer, *outside])),
        beneath.first_hits(origin, sampled).distance,
    )


def surfaces_beneath(
    body: BodyModel, poses: Poses, garments: OutfitSimulation | None, frame: int
) -> Surfaces:
    """The body without head and fingers, and the simulated garments, in a frame of the take."""
    collider = BodyCollider(body, poses.betas, friction=0.0)
    vertices = collider.vertices(poses.rotations[frame], poses.translation[frame])
    surfaces: Surfaces = [(vertices, collider.surface.faces)]
    if garments is not None:
        positions = garments.positions(poses, frame)
        surfaces += [(positions[name], pattern.faces) for name, pattern in garments.patterns.items()]
    return surfaces


def chosen_cameras(take: Take) -> list[str]:
    """Some of the training cameras, evenly around."""
    names = list(take.training_cameras)
    rows = np.unique(np.linspace(0, len(names), min(MOST_CAMERAS, len(names)), endpoint=False).astype(int))
    return [names[row] for row in rows]

"""How well a garment's place agrees with the label images of the take.

The garment's texels are drawn as discs into every camera. Where only the drawing or only the label image
shows the garment, its place is wrong. Pixels of other layers do not count, because they may lie in front.
Offsets that training tracked cannot judge this: where tracking was lost they stay near the bones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture import Camera, Take
from stages.shared.layers import LABELS, NO_LABEL

MOST_FRAMES = 24
MOST_CAMERAS = 4
_NEAREST = 1e-2  # metres before a camera


@dataclass(frozen=True, eq=False)
class OutlineView:
    """One camera in one frame: where the garment is seen, and where nobody is (H, W)."""

    camera: Camera
    garment: NDArray[np.bool_]
    empty: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Outlines:
    """Label images of one garment, by frame."""

    views: dict[int, list[OutlineView]]
    pitch: float

    def disagreement(self, frame: int, places: NDArray) -> float:
        """1 − IoU of the garment at (N, 3) m, world, with the label images of a frame, over its cameras."""
        both = either = 0
        for view in self.views[frame]:
            drawn = draw(view.camera, places, self.pitch)
            both += int((drawn & view.garment).sum())
            either += int((view.garment | (drawn & view.empty)).sum())
        return 1.0 - both / either if either else 0.0


def read_outlines(take: Take, frames: list[int], layer: str, pitch: float) -> Outlines | None:
    """Label images of a garment in the chosen frames; None where the take has none.

    Arguments:
        pitch: metres between texels.
    """
    ids = [label for label, name in LABELS.items() if name == layer]
    views: dict[int, list[OutlineView]] = {}
    for frame in frames:
        for name in chosen_cameras(take):
            if not take.has_image(name, frame):
                continue
            labels = take.labels(name, frame)
            if labels is None:
                continue
            view = OutlineView(take.camera(name), np.isin(labels, ids), labels == NO_LABEL)
            views.setdefault(frame, []).append(view)
    return Outlines(views, pitch) if views else None


def chosen_cameras(take: Take) -> list[str]:
    """Some of the training cameras, evenly around."""
    names = list(take.training_cameras)
    rows = np.unique(np.linspace(0, len(names), min(MOST_CAMERAS, len(names)), endpoint=False).astype(int))
    return [names[row] for row in rows]


def draw(camera: Camera, places: NDArray, pitch: float) -> NDArray[np.bool_]:
    """(H, W) where discs of the texels at (N, 3) m cover the picture, wide enough to leave no gaps."""
    turn, move = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    at = places @ turn.T + move
    at = at[at[:, 2] > _NEAREST]
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    if not len(at):
        return drawn.astype(bool)
    pixels = at @ camera.intrinsics.T
    column, row = np.floor(np.clip(pixels[:, :2] / pixels[:, 2:], -1e6, 1e6)).astype(np.int64).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    drawn[row[inside], column[inside]] = 1
    size = float(camera.intrinsics[0, 0] * pitch / np.median(at[:, 2]))
    radius = max(1, round(0.75 * size))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode(cv2.dilate(drawn, kernel), kernel).astype(bool)

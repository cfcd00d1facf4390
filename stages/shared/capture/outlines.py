"""How well a moving mesh fills the silhouettes of a take."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from stages.shared.capture.take import MASK_THRESHOLD, Take
from stages.shared.meshes.raycast import RayScene


def filmed_frames(take: Take) -> list[int]:
    """Rows of the take's poses that its first training camera filmed."""
    first = take.training_cameras[0]
    return [frame for frame in range(len(take.poses.rotations)) if take.has_image(first, frame)]


def outline_agreement(
    posed: Callable[[int], np.ndarray],
    faces: np.ndarray,
    take: Take,
    frames: Sequence[int],
    cameras: Sequence[str],
) -> dict[int, float]:
    """Mean silhouette IoU of each frame: the mesh rendered through pixel centres against mask > 127.

    Arguments:
        posed: frame -> vertices (V, 3) m, world. faces: (F, 3).
    """
    found = {}
    for frame in frames:
        scene = RayScene(posed(frame), faces)
        scores = [
            _agreement(scene.render(take.camera(camera)).hit, take.mask(camera, frame) > MASK_THRESHOLD)
            for camera in cameras
            if take.has_image(camera, frame)
        ]
        known = [score for score in scores if score is not None]
        if known:
            found[frame] = float(np.mean(known))
    return found


def _agreement(shown: np.ndarray, mask: np.ndarray) -> float | None:
    """Intersection over union; None where both are empty. (The metrics stand above captures.)"""
    union = int(np.logical_or(shown, mask).sum())
    return int(np.logical_and(shown, mask).sum()) / union if union else None

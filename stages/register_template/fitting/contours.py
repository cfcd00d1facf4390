"""Masks of one frame for a fit: signed distances, and contour points with their outward normals."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.register_template.fitting.bones import Doubles
from stages.register_template.silhouettes import signed_distance
from stages.shared.capture import Take
from stages.shared.capture.camera import Camera
from stages.shared.capture.take import MASK_THRESHOLD
from stages.shared.layers import LABEL_IDS, NO_LABEL, SKIN_CONTACT

LONG_SIDE = 384  # pixels at which masks are compared
_BLUR = 1.5  # pixels, of the field that normals come from
_BORDER = 2.5  # pixels; a contour there is the edge of the image, not of the person
_FINGERPRINT = 5  # side of the square of pixels in which labels next to the contour are looked for


@dataclass(frozen=True, eq=False)
class View:
    """One camera and the mask it has of one frame.

    Attributes:
        camera: scaled to the mask below.
        distance: (H, W) f32 pixels to the edge of the mask, positive inside.
        slope: (H, W, 2) f32 its derivative along x and y.
        contour: (M, 2) pixels on the edge. normals: (M, 2) pointing out of the mask.
        contact: (M,) 1 where the edge is bare skin, down to 0 for loose cloth; None without label images.
    """

    camera: Camera
    distance: NDArray[np.float32]
    slope: NDArray[np.float32]
    contour: Doubles
    normals: Doubles
    contact: Doubles | None


def views_of(take: Take, frame: int, contour_points: int = 400) -> list[View]:
    """The training views of one frame that show the person; views with an empty mask are left out.

    Raises:
        BadData: no view shows the person.
    """
    names = [name for name in take.training_cameras if take.has_image(name, frame)]
    views = [_view(take, name, frame, contour_points) for name in names]
    if names and not any(views):
        raise take.empty_mask(names[0], frame)
    return [view for view in views if view is not None]


def _view(take: Take, name: str, frame: int, count: int) -> View | None:
    mask, camera = take.mask(name, frame), take.camera(name)
    if mask.max(initial=0) <= MASK_THRESHOLD:
        return None
    factor = min(1.0, LONG_SIDE / max(camera.width, camera.height))
    small = camera.scaled(factor)
    resized = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA)
    inside = resized > MASK_THRESHOLD
    distance = signed_distance(inside)
    smooth = cv2.GaussianBlur(distance, (0, 0), _BLUR)
    slope = np.stack(
        [cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)],
        axis=-1,
    )
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    pixels = np.concatenate([line.reshape(-1, 2) for line in contours])
    away = (pixels > _BORDER).all(axis=1) & (pixels < [small.width - _BORDER, small.height - _BORDER]).all(
        axis=1
    )
    pixels = pixels[away] if away.any() else pixels
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(count, len(pixels))).astype(int)]
    outward = -slope[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    sure = length[:, 0] > 0.2  # at the tip of a finger the distance has no direction
    pixels, outward = pixels[sure], outward[sure] / length[sure]
    # Contour pixels lie inside; the edge runs half a pixel further out.
    return View(
        small,
        distance,
        slope.astype(np.float32),
        pixels + 0.5 + 0.5 * outward,
        outward,
        _contact(take, name, frame, pixels, factor),
    )


def _contact(take: Take, name: str, frame: int, pixels: NDArray, factor: float) -> Doubles | None:
    """Contact (M,) at contour pixels (M, 2), from the most frequent label around each."""
    if take.view(name, frame).labels is None:
        return None
    labels = take.labels(name, frame)
    assert labels is not None
    full = np.rint((pixels + 0.5) / factor - 0.5).astype(int)
    reach = np.arange(_FINGERPRINT) - _FINGERPRINT // 2
    rows = np.clip(full[:, 1, None, None] + reach[:, None], 0, labels.shape[0] - 1)
    columns = np.clip(full[:, 0, None, None] + reach[None, :], 0, labels.shape[1] - 1)
    around = labels[rows, columns].reshape(len(pixels), -1)
    counts = np.stack([(around == label).sum(axis=1) for label in LABEL_IDS], axis=1)
    commonest = np.where(counts.any(axis=1), np.array(LABEL_IDS)[counts.argmax(axis=1)], NO_LABEL)
    contact = np.zeros(len(pixels))
    for label, share in SKIN_CONTACT.items():
        contact[commonest == label] = share
    return contact

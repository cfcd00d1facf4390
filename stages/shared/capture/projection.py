"""Colours and labels of surface points out of the images that see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.take import Take
from stages.shared.errors import MissingInput
from stages.shared.finite import finite, require_finite
from stages.shared.layers import LABEL_IDS, NO_LABEL
from stages.shared.meshes.raycast import RayScene

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

_OFFSET = 0.001  # m above the surface, so that a point is not hidden by the faces it lies on
_TOLERANCE = 0.002  # m; what is this near to the point does not hide it
_DEPTH_STEP = 0.01  # m beside two pixels' widths: a silhouette, where images mix two surfaces
_BORDER = 4  # pixels around the points that are looked at
_FAR = 1e6  # m, depth of the background
_EDGE_WEIGHT = 0.02  # left to a view whose pixel lies on a silhouette: used when there is no other
_SURE = 250  # mask value from which a pixel shows nothing of the background
_SHARPNESS = 8  # of the blend: views that see a point half as well count a 256th


@dataclass(frozen=True, eq=False)
class Sight:
    """What one camera sees of N points.

    Attributes:
        pixels: (N, 2) f64 x, y; NaN behind the camera.
        visible: (N,) on the image and not hidden.
        cosine: (N,) f32 between normal and direction to the camera, 0 where it is not visible.
        density: (N,) f32 pixels per metre of a surface that faces the camera.
    """

    pixels: NDArray[np.float64]
    visible: Flags
    cosine: Floats
    density: Floats


def visibility(points: ArrayLike, normals: ArrayLike, camera: Camera, occluder: RayScene) -> Sight:
    """Which points a camera sees, and how squarely; points and unit normals (N, 3) in the world frame.

    A point is hidden when something of `occluder` lies between it and the camera, or when it faces away.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    pixels, depth = camera.project(points)
    towards = camera.centre - points
    distance = np.linalg.norm(towards, axis=1)
    cosine = np.einsum("nk,nk->n", towards, normals) / np.maximum(distance, 1e-9)
    candidate = camera.in_view(pixels) & (cosine > 0)
    visible = candidate.copy()
    lifted = points[candidate] + _OFFSET * normals[candidate]
    visible[candidate] = ~occluder.occluded(camera.centre, lifted, _TOLERANCE)
    focal = np.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1])
    density = focal / np.maximum(depth, 1e-6)
    return Sight(
        pixels,
        visible,
        np.where(visible, cosine, 0).astype(np.float32),
        np.where(visible, density, 0).astype(np.float32),
    )


def project_colors(
    points: ArrayLike,
    normals: ArrayLike,
    occluder: RayScene,
    take: Take,
    frame: int,
    cameras: Sequence[str] | None = None,
    labels: NDArray[np.uint8] | None = None,
) -> tuple[Floats, Floats]:
    """Colours of surface points from the images of one frame.

    Every point takes the views that see it best (weight: cosine x pixel density, to a high power, so that
    patterns stay sharp where views disagree by a pixel, and no seam shows where the best view changes).

    Arguments:
        points: (N, 3) world, metres. normals: (N, 3) unit.
        occluder: the surface of that frame; what it hides is not seen.
        take, frame: the images.
        cameras: names; the training cameras by default.
        labels: (N,) label id of each point. Where a view has a label image, its pixels of other labels count
            as outside of the mask for that point.

    Returns:
        Colours (N, 3) f32 sRGB in [0, 1], 0 where no camera sees the point; and confidence (N,) f32, the
        cosine of the best view, near 0 on silhouettes and 0 where unseen.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    names = _views(take, frame, cameras)
    scores = np.zeros((len(names), len(points)), np.float32)
    samples = np.zeros((len(names), len(points), 3), np.float32)
    confidence = np.zeros(len(points), np.float32)
    for view, name in enumerate(names):
        sight = visibility(points, normals, take.camera(name), occluder)
        seen = sight.visible
        ids = None if labels is None else labels[seen]
        factor = _edge_factor(take, name, frame, occluder, sight.pixels[seen], ids)
        scores[view, seen] = sight.cosine[seen] * sight.density[seen] * factor
        samples[view, seen] = sample_bilinear(take.image(name, frame), sight.pixels[seen]) / np.float32(255)
        confidence[seen] = np.maximum(confidence[seen], sight.cosine[seen] * factor)
    best = scores.max(axis=0)
    weights = (scores / np.maximum(best, 1e-12)) ** _SHARPNESS * (best > 0)
    total = weights.sum(axis=0)
    colors = np.einsum("cn,cnk->nk", weights, samples) / np.maximum(total, 1e-12)[:, None]
    return np.clip(colors, 0, 1).astype(np.float32), confidence


def project_labels(
    points: ArrayLike,
    normals: ArrayLike,
    occluder: RayScene,
    take: Take,
    frame: int,
    cameras: Sequence[str] | None = None,
) -> Floats:
    """Votes (N, 6) f32 for the ids 0 to 5 of surface points, from the label images of one frame.

    Each camera that sees a point votes with the four pixels around it, weighted by the cosine of its view;
    pixels without a label do not vote. A row of zeros: no camera sees the point. Arguments as in
    `project_colors`.

    Raises:
        MissingInput: no camera has a label image of this frame.
    """
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    votes = np.zeros((len(points), len(LABEL_IDS)), np.float32)
    names = [name for name in _views(take, frame, cameras) if take.view(name, frame).labels]
    if not names:
        raise MissingInput(
            "There are no label images of this frame.",
            f"{take.name}, frame {frame}",
            "Add label images (ids 0 to 5, 255 for none), or give a scan with labels.",
        )
    for name in names:
        labels = take.labels(name, frame)
        assert labels is not None
        sight = visibility(points, normals, take.camera(name), occluder)
        seen = np.flatnonzero(sight.visible)
        weight = sight.cosine[seen] * _edge_factor(take, name, frame, occluder, sight.pixels[seen])
        for rows, columns, share in _four_pixels(sight.pixels[seen], labels.shape[1], labels.shape[0]):
            ids = labels[rows, columns]
            labelled = ids != NO_LABEL
            np.add.at(votes, (seen[labelled], ids[labelled]), (weight * share)[labelled])
    return votes


def sample_bilinear(image: NDArray[np.uint8] | Floats, pixels: NDArray[np.float64]) -> Floats:
    """Values (N, C) f32 of an image (H, W, C) at pixels (N, 2) x, y; pixel centres at integer + 0.5."""
    require_finite("sample_bilinear", pixels=pixels)
    result = np.zeros((len(pixels), image.shape[2]), np.float32)
    for rows, columns, share in _four_pixels(pixels, image.shape[1], image.shape[0]):
        result += share[:, None] * image[rows, columns]
    return finite(result, "sample_bilinear", image=image)


def _four_pixels(
    pixels: NDArray[np.float64], width: int, height: int
) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
    """Rows, columns and bilinear shares of the four pixels around each of (N, 2)."""
    # Far outside the picture, the border is all there is: no pixel number may leave the range of integers.
    x = np.clip(pixels[:, 0] - 0.5, -2.0, width + 1.0)
    y = np.clip(pixels[:, 1] - 0.5, -2.0, height + 1.0)
    left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    right_share, bottom_share = x - left, y - top
    return [
        (
            np.clip(top + down, 0, height - 1),
            np.clip(left + right, 0, width - 1),
            (
                (right_share if right else 1 - right_share) * (bottom_share if down else 1 - bottom_share)
            ).astype(np.float32),
        )
        for down in (0, 1)
        for right in (0, 1)
    ]


def _edge_factor(
    take: Take,
    name: str,
    frame: int,
    occluder: RayScene,
    pixels: NDArray[np.float64],
    ids: NDArray[np.uint8] | None = None,
) -> Floats:
    """(N,) 1, or `_EDGE_WEIGHT` where a pixel of the image mixes two surfaces or lies outside the mask.

    Arguments:
        pixels: (N, 2) on the image. ids: (N,) labels of the points; see `project_colors`.
    """
    if not len(pixels):
        return np.ones(0, np.float32)
    camera = take.camera(name)
    left, top = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - _BORDER, 0).tolist()
    right, bottom = (np.ceil(pixels.max(axis=0)).astype(int) + _BORDER).tolist()
    box = left, top, min(right, camera.width), min(bottom, camera.height)
    camera = camera.crop(box)
    rows_columns = slice(box[1], box[3]), slice(box[0], box[2])
    mask = take.mask(name, frame)[rows_columns]
    depth = occluder.render(camera).distance
    depth = np.where(np.isfinite(depth), depth, _FAR).astype(np.float32)
    # Second differences are small on a slope, however steep, and large at a step.
    step = np.zeros(depth.shape, bool)
    allowed = _DEPTH_STEP + 2 * depth / camera.intrinsics[0, 0]
    for axis in (0, 1):
        before, after = np.roll(depth, 1, axis), np.roll(depth, -1, axis)
        step |= np.abs(before - 2 * depth + after) > allowed
    columns = np.clip(pixels[:, 0].astype(np.intp) - left, 0, camera.width - 1)
    rows = np.clip(pixels[:, 1].astype(np.intp) - top, 0, camera.height - 1)
    shown = None if ids is None else take.labels(name, frame)
    if ids is None or shown is None:
        mixed = (step | _unsure(mask))[rows, columns]
    else:
        shown, mixed = shown[rows_columns], step[rows, columns]
        for label in np.unique(ids):
            own = ids == label
            mixed[own] |= _unsure(np.where(shown == label, mask, 0).astype(np.uint8))[rows[own], columns[own]]
    return np.where(mixed, np.float32(_EDGE_WEIGHT), np.float32(1))


def _unsure(mask: NDArray[np.uint8]) -> Flags:
    """(h, w) where a pixel or one next to it shows something of the background."""
    return np.asarray(cv2.dilate((mask < _SURE).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _views(take: Take, frame: int, cameras: Sequence[str] | None) -> list[str]:
    names = [name for name in (cameras or take.training_cameras) if take.has_image(name, frame)]
    if not names:
        raise MissingInput(
            "No camera has an image of this frame.",
            f"{take.name}, frame {frame}",
            "Choose a frame that was captured.",
        )
    return names

"""Masks of one instant made to agree: what the other views exclude goes, holes that they fill are closed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera

Doubles = NDArray[np.float64]
_Image = NDArray[np.uint8]

_PITCH_M = 0.025
_MARGIN_M = 0.35
_HALF_SIDE_M = 1.3
_FEWEST_CAMERAS = 4
# Share of the other cameras that must see a point inside, for its pixels to stay and for them to be filled.
_STAYS, _FILLED = 0.6, 0.9
_VIEW_SHARE, _ENOUGH_VIEWS = 0.5, 8  # of the cameras: how many must have a point in view, and at most
_POSSIBLY_INSIDE = 64  # coverage that speaks against an exclusion
_DENSE = 10  # with so many cameras their hull is close to the person, and may fill holes
_MOST_CHANGE = 0.25  # of a mask: more than this means a wrong calibration, not a wrong mask


def consistent_masks(
    cameras: Sequence[Camera], masks: Sequence[_Image], points: Doubles | None = None
) -> list[_Image]:
    """The masks (H, W) u8 of one instant, each corrected by the hull of the others.

    A mask that would lose more than a quarter is left as it is: then the cameras disagree, not the masks.

    Arguments:
        points: (L, 3) landmarks of the person, world, metres, NaN where unknown; without them the person is
            looked for where the views of all masks meet.
    """
    filled = [index for index, mask in enumerate(masks) if (mask > 127).any()]
    if len(filled) < _FEWEST_CAMERAS:
        return list(masks)
    nodes = _nodes(*_box([cameras[i] for i in filled], [masks[i] for i in filled], points))
    pixels = [cameras[index].project(nodes)[0] for index in filled]
    seen = np.stack([cameras[index].in_view(place) for index, place in zip(filled, pixels, strict=True)])
    inside = np.zeros(seen.shape, bool)
    for row, index in enumerate(filled):
        reach = _node_radius(cameras[index], nodes)
        grown = cv2.dilate(masks[index], np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        columns, rows = pixels[row][seen[row]].astype(int).T
        inside[row, seen[row]] = grown[rows, columns] > _POSSIBLY_INSIDE
    result = list(masks)
    enough = max(2, min(_ENOUGH_VIEWS, int(np.ceil(_VIEW_SHARE * len(filled)))))
    for row, index in enumerate(filled):
        views = seen.sum(axis=0) - seen[row]
        share = (inside.sum(axis=0) - inside[row]) / np.maximum(views, 1)
        radius = _node_radius(cameras[index], nodes)
        visible = seen[row] & (views >= enough)
        hull = _drawn(pixels[row][visible & (share >= _STAYS)], masks[index].shape, radius)
        result[index] = _without_excluded(masks[index], hull, radius)
        if len(filled) > _DENSE:
            core = _drawn(pixels[row][visible & (share >= _FILLED)], masks[index].shape, radius)
            result[index] = np.where(_shrunk(core, 3 * radius), np.uint8(255), result[index])
    return result


def _without_excluded(mask: _Image, hull: _Image, radius: int) -> _Image:
    inside = mask > 127
    allowed = cv2.dilate(hull, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)) > 0
    if (inside & ~allowed).sum() > _MOST_CHANGE * inside.sum():
        return mask
    return np.where(allowed, mask, 0).astype(np.uint8)


def _shrunk(hull: _Image, pixels: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.erode(hull, np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)) > 0)


def _drawn(pixels: Doubles, shape: tuple[int, ...], radius: int) -> _Image:
    """(H, W) u8: 1 around the pixels."""
    picture = np.zeros(shape, np.uint8)
    columns, rows = pixels.astype(int).T
    picture[rows, columns] = 1
    side = 2 * radius + 1
    return np.asarray(cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)), np.uint8)


def _node_radius(camera: Camera, nodes: Doubles) -> int:
    """Half the distance of two nodes in pixels, at the middle of the box."""
    depth = float(camera.project(nodes.mean(axis=0))[1])
    return max(1, int(np.ceil(0.5 * _PITCH_M * camera.intrinsics[0, 0] / max(depth, 0.1))))


def _box(
    cameras: Sequence[Camera], masks: Sequence[_Image], points: Doubles | None
) -> tuple[Doubles, Doubles]:
    if points is not None and np.isfinite(points).all(axis=1).sum() >= 4:
        known = points[np.isfinite(points).all(axis=1)]
        return known.min(axis=0) - _MARGIN_M, known.max(axis=0) + _MARGIN_M
    middle = meeting_point(cameras, masks)
    return middle - _HALF_SIDE_M, middle + _HALF_SIDE_M


def meeting_point(cameras: Sequence[Camera], masks: Sequence[_Image]) -> Doubles:
    """(3,) the point nearest to the rays through the middles of all masks (least squares)."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for camera, mask in zip(cameras, masks, strict=True):
        rows, columns = np.nonzero(mask > 127)
        ray = np.linalg.inv(camera.intrinsics) @ [columns.mean() + 0.5, rows.mean() + 0.5, 1.0]
        ray = camera.camera_from_world[:3, :3].T @ ray
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        right += across @ camera.centre
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), right), np.float64)


def _nodes(low: Doubles, high: Doubles) -> Doubles:
    axes = [np.arange(first, last + _PITCH_M, _PITCH_M) for first, last in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

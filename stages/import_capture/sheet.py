"""A contact sheet of an import: the cameras from above and from the side, and a picture of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.pictures.sheet import contact_sheet, shrunk

_Image = NDArray[np.uint8]
Doubles = NDArray[np.float64]

_MAP_SIDE, _PICTURE_SIDE, _COLUMNS = 520, 300, 6
_PAPER, _INK, _PERSON = (250, 250, 250), (60, 60, 60), (200, 60, 40)
_VIEW_LENGTH = 0.12  # of the map: how long a camera's line of sight is drawn


def camera_sheet(
    cameras: Sequence[Camera],
    pictures: Mapping[str, tuple[_Image, _Image | None]],
    captions: Mapping[str, str],
    points: Doubles | None,
) -> _Image:
    """Cameras from above and from the side, above a picture of each with the outline of its mask.

    Arguments:
        pictures: camera name to picture (H, W, 3) u8 and mask (H, W) u8 if there is one.
        points: (L, 3) landmarks of the person, world, metres.
    """
    maps = [_map(cameras, points, axes) for axes in ((0, 2), (0, 1))]
    shown = [_outlined(*pictures[camera.name]) for camera in cameras if camera.name in pictures]
    texts = [captions.get(camera.name, camera.name) for camera in cameras if camera.name in pictures]
    top = contact_sheet(maps, 2, ["from above (x right, z down)", "from the side (x right, y up)"])
    below = contact_sheet(shown, min(_COLUMNS, max(1, len(shown))), texts)
    width = max(top.shape[1], below.shape[1])
    padded = [
        np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), constant_values=245)
        for part in (top, below)
    ]
    return np.concatenate(padded)


def _map(cameras: Sequence[Camera], points: Doubles | None, axes: tuple[int, int]) -> _Image:
    """The cameras with lines of sight, seen along the third axis; a grid line every metre."""
    known = np.empty((0, 3)) if points is None else points[np.isfinite(points).all(axis=1)]
    centres = np.stack([camera.centre for camera in cameras])
    everything = np.concatenate([centres, known])[:, axes]
    low, high = everything.min(axis=0), everything.max(axis=0)
    side = 1.2 * max(float((high - low).max()), 1e-3)
    corner = (low + high) / 2 - side / 2
    upward = axes[1] == 1

    def pixel(place: Doubles) -> tuple[int, int]:
        x, y = (place - corner) / side * _MAP_SIDE
        return round(float(x)), round(float(_MAP_SIDE - y if upward else y))

    picture = np.full((_MAP_SIDE, _MAP_SIDE, 3), _PAPER, np.uint8)
    for metre in range(int(np.floor(corner.min())), int(np.ceil(corner.max() + side)) + 1)[:60]:
        for axis in (0, 1):
            ends = [corner.copy(), corner + side]
            for end in ends:
                end[axis] = metre
            cv2.line(picture, pixel(ends[0]), pixel(ends[1]), (228, 228, 228), 1)
    for place in known:
        cv2.circle(picture, pixel(place[list(axes)]), 2, _PERSON, -1, cv2.LINE_AA)
    for camera in cameras:
        begin = camera.centre[list(axes)]
        ahead = begin + _VIEW_LENGTH * side * camera.camera_from_world[2, :3][list(axes)]
        cv2.line(picture, pixel(begin), pixel(ahead), _INK, 1, cv2.LINE_AA)
        cv2.circle(picture, pixel(begin), 4, _INK, -1, cv2.LINE_AA)
        x, y = pixel(begin)
        cv2.putText(
            picture, camera.name, (x + 6, y - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.36, _INK, 1, cv2.LINE_AA
        )
    return picture


def _outlined(image: _Image, mask: _Image | None) -> _Image:
    small = np.ascontiguousarray(shrunk(image, _PICTURE_SIDE))
    if mask is not None:
        size = (small.shape[1], small.shape[0])
        inside = (cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)
        lines, _ = cv2.findContours(inside, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(small, lines, -1, (60, 220, 60), 1)
    return small

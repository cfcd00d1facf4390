"""Masks as signed distances, and the field whose zero level is their visual hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.projection import sample_bilinear
from stages.shared.capture.take import MASK_THRESHOLD, Take
from stages.shared.errors import BadData
from stages.shared.report import Report

Doubles = NDArray[np.float64]

# Space counts as inside only where this share of the cameras sees it: at least two cameras, at most four.
_VIEW_SHARE, _FEWEST_VIEWS, _ENOUGH_VIEWS = 0.4, 2, 4


@dataclass(frozen=True)
class Silhouette:
    """One camera and the signed distance (H, W, 1) f32 in pixels to the edge of its mask, positive inside."""

    camera: Camera
    distance: NDArray[np.float32]

    @property
    def focal(self) -> float:
        """Geometric mean of the two focal lengths, pixels."""
        return float(np.sqrt(self.camera.intrinsics[0, 0] * self.camera.intrinsics[1, 1]))


def silhouettes_of(take: Take, frame: int, fewest: int, purpose: str, report: Report) -> list[Silhouette]:
    """The silhouettes of one frame in the training cameras; views that show nobody are named and left out.

    Arguments:
        fewest: number of silhouettes that are needed. purpose: what for, for the message ("a hull").

    Raises:
        BadData: fewer cameras than that show the person.
    """
    views = [name for name in take.training_cameras if take.has_image(name, frame)]
    silhouettes, empty = [], []
    for name in views:
        mask = take.mask(name, frame)
        if mask.max(initial=0) > MASK_THRESHOLD:
            silhouettes.append(silhouette(take.camera(name), mask))
        else:
            empty.append(name)
    if len(silhouettes) < fewest:
        raise BadData(
            f"Only {len(silhouettes)} cameras see the person in frame {frame}; {purpose} needs {fewest}.",
            f"{take.name}, frame {frame}" + (f"; empty masks of {', '.join(empty)}" if empty else ""),
            "Choose another --frame, give a scan, or choose --template body.",
        )
    if empty:
        report.warn(
            f"{take.name}, frame {frame}: nobody is seen by {', '.join(empty)}; these views are left out"
        )
    return silhouettes


def silhouette(camera: Camera, mask: NDArray[np.uint8]) -> Silhouette:
    """Signed distance to the edge of a mask (H, W) that shows the person, refined by the mask's soft edge."""
    distance = signed_distance(mask > MASK_THRESHOLD)
    edge = np.abs(distance) < 1
    distance[edge] = mask[edge] / 255.0 - 0.5
    return Silhouette(camera, distance[..., None].astype(np.float32))


def signed_distance(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(H, W) f32 pixels to the edge of a mask, positive inside."""
    deep = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    far = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    return np.where(inside, deep - 0.5, 0.5 - far).astype(np.float32)


def fewest_views(cameras: int) -> int:
    """How many of the cameras must have a point in view before their masks say that it is inside."""
    share = int(np.ceil(_VIEW_SHARE * cameras))
    return min(max(share, _FEWEST_VIEWS), _ENOUGH_VIEWS)


def hull_field(nodes: Doubles, silhouettes: Sequence[Silhouette], outside: float) -> Doubles:
    """Signed distance (N,) f64 in metres to the hull of the masks at world points (N, 3), positive inside.

    A camera that does not see a point says nothing about it. A point that fewer than `fewest_views` cameras
    see is outside: nothing is known about it, and counting it as inside fills the space around the person.

    Arguments:
        outside: metres by which such points lie outside; positive.
    """
    views = np.zeros(len(nodes), np.int32)
    values = np.full(len(nodes), np.inf)
    for one in silhouettes:
        pixels, depth = one.camera.project(nodes)
        in_view = one.camera.in_view(pixels)
        metres_per_pixel = depth[in_view] / one.focal
        distance = sample_bilinear(one.distance, pixels[in_view])[:, 0] * metres_per_pixel
        values[in_view] = np.minimum(values[in_view], distance)
        views += in_view
    values[views < fewest_views(len(silhouettes))] = -outside
    return values

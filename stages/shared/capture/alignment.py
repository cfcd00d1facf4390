"""Do calibration, poses and masks belong together? The posed body, projected, must lie inside the masks.

A body model is thinner than the dressed person, so nearly all of its silhouette is inside the mask when the
cameras are right, and nearly none of it when an axis is turned round.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.alignment_causes import (
    LONG_SIDE,
    global_cause,
    label_warnings,
    likely_cause,
    silhouette,
    small_mask,
    suspicious_cameras,
)
from stages.shared.capture.convention import AS_IS, CONVENTIONS, take_in_convention
from stages.shared.capture.take import MASK_THRESHOLD, Take
from stages.shared.errors import BadData
from stages.shared.meshes.raycast import RayScene

BAR = 0.90  # of the silhouette, on average over the cameras
CAMERA_BAR = 0.70  # for each camera
COVER_BAR = 0.15  # of the mask that the body must cover: a body of the wrong scale is a dot inside every mask
_Vertices = Mapping[int, NDArray[np.floating]]


@dataclass(frozen=True)
class Alignment:
    """How well the body fits the masks.

    Attributes:
        convention: how the camera matrices had to be read (`CONVENTIONS`); "as is" means as the capture says.
        inside: camera to the share of the body's silhouette inside the mask, mean of the frames looked at.
        covered: camera to the share of the mask that the body covers.
        tried: convention to the mean share inside, in the order tried.
        frames: the frames looked at.
        warnings: cameras that are far worse than the others, and views without a person, in sentences.
    """

    convention: str
    inside: dict[str, float]
    covered: dict[str, float]
    tried: dict[str, float]
    frames: tuple[int, ...]
    warnings: tuple[str, ...] = ()

    @property
    def mean_inside(self) -> float:
        """Mean share inside over the cameras."""
        return float(np.mean(list(self.inside.values())))


def check_alignment(
    take: Take, vertices: _Vertices, faces: NDArray[np.integer], bar: float = BAR
) -> Alignment:
    """Project the posed body into the masks; find the camera convention in which it fits.

    Arguments:
        take: cameras and masks.
        vertices: frame to vertices (V, 3) of the posed body, world, metres; two or three frames will do.
        faces: (F, 3) of the body.
        bar: least mean share inside.

    Raises:
        BadData: an empty mask, or no convention fits: the shares of each one tried are named.
    """
    views = [
        (name, frame) for name in take.training_cameras for frame in vertices if take.has_image(name, frame)
    ]
    seen = {view: small_mask(take, *view) for view in views}
    masks = {view: mask for view, mask in seen.items() if mask is not None}
    if not masks:
        raise take.empty_mask(*views[0])
    scenes = {frame: RayScene(vertices[frame], faces) for frame in vertices}
    tried: dict[str, float] = {}
    best: Alignment | None = None
    for convention in CONVENTIONS:
        inside, covered = _shares(take_in_convention(take, convention), masks, scenes)
        tried[convention] = float(np.mean(list(inside.values())))
        found = Alignment(convention, inside, covered, tried, tuple(vertices))
        if best is None or found.mean_inside > best.mean_inside:
            best = found
        if convention == AS_IS and _passes(found, bar):
            return replace(found, warnings=_warnings(take, found, scenes, seen))
    assert best is not None
    if not _passes(best, bar):
        raise _refusal(take, best, bar, masks, scenes)
    return replace(best, warnings=_warnings(take_in_convention(take, best.convention), best, scenes, seen))


def overlay_picture(
    take: Take,
    frame: int,
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    inside: Mapping[str, float],
) -> NDArray[np.uint8]:
    """A sheet (H, W, 3) u8 sRGB of all training views: outlines of body (magenta) and mask (green)."""
    scene = RayScene(vertices, faces)
    tiles = []
    for name in take.training_cameras:
        if not take.has_image(name, frame):
            continue
        camera = take.camera(name)
        factor = LONG_SIDE / max(camera.width, camera.height)
        small = camera.scaled(factor)
        size = (small.width, small.height)
        image = np.array(cv2.resize(take.image(name, frame), size, interpolation=cv2.INTER_AREA), np.uint8)
        tile = np.zeros((LONG_SIDE, LONG_SIDE, 3), np.uint8)
        mask = cv2.resize(take.mask(name, frame), size, interpolation=cv2.INTER_AREA)
        _draw_outline(image, mask > MASK_THRESHOLD, (60, 220, 60))
        _draw_outline(image, scene.render(small).hit, (255, 0, 200))
        tile[: small.height, : small.width] = image
        text = name + (f"  {100 * inside[name]:.1f} % inside" if name in inside else "")
        cv2.putText(
            tile, text, (6, LONG_SIDE - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA
        )
        tiles.append(tile)
    return contact_sheet(tiles)


def silhouette_ious(
    take: Take, frame: int, vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> dict[str, float]:
    """Camera to intersection over union of a surface's silhouette and the mask; training views."""
    scene = RayScene(vertices, faces)
    found = {}
    for name in take.training_cameras:
        if take.has_image(name, frame):
            mask = small_mask(take, name, frame)
            if mask is None:
                continue
            hit = silhouette(scene, take.camera(name))
            found[name] = float((hit & mask).sum() / max(int((hit | mask).sum()), 1))
    return found


def contact_sheet(tiles: list[NDArray[np.uint8]], columns: int = 4) -> NDArray[np.uint8]:
    """Pictures of one size in rows of `columns`, black where there are too few."""
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    blank = np.zeros_like(tiles[0])
    padded = tiles + [blank] * (rows * columns - len(tiles))
    return np.concatenate(
        [np.concatenate(padded[row * columns : (row + 1) * columns], axis=1) for row in range(rows)], axis=0
    )


def _draw_outline(image: NDArray[np.uint8], inside: NDArray[np.bool_], color: tuple[int, int, int]) -> None:
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, color, 1)


def _shares(
    take: Take, masks: Mapping[tuple[str, int], NDArray[np.bool_]], scenes: Mapping[int, RayScene]
) -> tuple[dict[str, float], dict[str, float]]:
    """Camera to share of the silhouette inside the mask, and to share of the mask covered."""
    inside: dict[str, list[float]] = {}
    covered: dict[str, list[float]] = {}
    for (name, frame), mask in masks.items():
        camera = take.camera(name)
        hit = silhouette(scenes[frame], camera)
        both = float((hit & mask).sum())
        inside.setdefault(name, []).append(both / max(int(hit.sum()), 1))
        covered.setdefault(name, []).append(both / max(int(mask.sum()), 1))
    return (
        {name: float(np.mean(shares)) for name, shares in inside.items()},
        {name: float(np.mean(shares)) for name, shares in covered.items()},
    )


def _passes(found: Alignment, bar: float) -> bool:
    return (
        found.mean_inside >= bar
        and min(found.inside.values()) >= CAMERA_BAR
        and float(np.mean(list(found.covered.values()))) >= COVER_BAR
    )


def _warnings(
    take: Take, found: Alignment, scenes: Mapping[int, RayScene], seen: Mapping[tuple[str, int], object]
) -> tuple[str, ...]:
    """What the mean over the cameras does not show."""
    empty = [f"{name}, frame {frame}" for (name, frame), mask in seen.items() if mask is None]
    warnings = [f"nobody is seen by {'; '.join(empty)}: these views are left out."] if empty else []
    middle = float(np.median(list(found.inside.values())))
    for name in suspicious_cameras(found.inside, found.covered):
        cause = likely_cause(take, name, scenes)
        warnings.append(
            f"camera {name} has {100 * found.inside[name]:.0f} % of the body in its masks, the median camera "
            f"{100 * middle:.0f} %" + (f": {cause}." if cause else ". Look at its calibration and masks.")
        )
    return (*warnings, *label_warnings(take, found.frames[0]))


def _refusal(
    take: Take,
    best: Alignment,
    bar: float,
    masks: Mapping[tuple[str, int], NDArray[np.bool_]],
    scenes: Mapping[int, RayScene],
) -> BadData:
    shares = "; ".join(f"{name}: {100 * share:.0f} %" for name, share in best.tried.items())
    where = f"{take.name}, frames {', '.join(map(str, best.frames))}; camera matrices tried {shares}"
    worst = min(best.inside, key=lambda name: best.inside[name])
    covered = float(np.mean(list(best.covered.values())))
    if float(np.median(list(best.inside.values()))) >= bar and best.inside[worst] < CAMERA_BAR:
        fitting = take_in_convention(take, best.convention)
        wrong = [name for name, share in best.inside.items() if share < CAMERA_BAR]
        causes = [f"{name}: {cause}" for name in wrong if (cause := likely_cause(fitting, name, scenes))]
        return BadData(
            f"Camera {worst} has {100 * best.inside[worst]:.0f} % of the projected body in its mask; "
            "the median camera fits." + (f" Likely causes: {'; '.join(causes)}." if causes else ""),
            where,
            f"Correct the calibration or the masks of {', '.join(wrong)}, or leave these cameras out.",
        )
    if best.mean_inside >= bar:
        return BadData(
            f"The projected body covers only {100 * covered:.1f} % of the masks: wrong scale or place.",
            where,
            "Check the units of calibration and poses: both must be metres.",
        )
    cause = global_cause(take, masks, scenes)
    if cause:
        return BadData(
            f"Only {100 * best.mean_inside:.0f} % of the projected body is in the masks; {cause}.",
            where,
            "Correct the masks, the frame numbers or the calibration accordingly.",
        )
    return BadData(
        f"Only {100 * best.mean_inside:.0f} % of the projected body is in the masks (bar {100 * bar:.0f} %): "
        "calibration, poses and masks do not belong together.",
        where,
        "Check calibration, units (metres), body model (--body-model) and frame numbers of poses and images.",
    )

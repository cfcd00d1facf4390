"""Why one camera, or all of them, fit the posed body badly: hypotheses, each tried on the masks.

A mean over cameras hides one that is wrong. A camera that is far worse than the others is named, with the
change under which its masks fit, where there is one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.capture.camera import Camera
from stages.shared.capture.take import MASK_THRESHOLD, Take
from stages.shared.meshes.raycast import RayScene

LONG_SIDE = 320  # pixels at which silhouettes are compared
_WORSE = 0.12  # below the median of the cameras' shares inside
_LESS_COVERED = 0.6  # of the median of the cameras' shares covered
_GAIN = 0.1  # of intersection over union, for a hypothesis to be named
_WHITE = 0.995  # share of a mask that is inside
_SHIFTS = (-8, -7, -6, -5, -4, -3, -2, -1, 1, 2, 3, 4, 5, 6, 7, 8)  # frames
_FOCALS = (0.5, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 2.0)
_LABELLED_OUTSIDE = 0.15
_LABELS_READ = 8  # cameras

Mask = NDArray[np.bool_]
Scenes = Mapping[int, RayScene]


def small_mask(take: Take, camera: str, frame: int) -> Mask | None:
    """The mask at the size at which silhouettes are compared; None where it shows nobody."""
    mask = take.mask(camera, frame)
    if mask.max(initial=0) <= MASK_THRESHOLD:
        return None
    small = take.camera(camera).scaled(min(1.0, LONG_SIDE / max(mask.shape)))
    resized = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized > MASK_THRESHOLD)


def silhouette(scene: RayScene, camera: Camera) -> Mask:
    """(h, w) where a surface is seen, at the size of `small_mask`."""
    return scene.render(camera.scaled(min(1.0, LONG_SIDE / max(camera.width, camera.height)))).hit


def suspicious_cameras(inside: Mapping[str, float], covered: Mapping[str, float]) -> list[str]:
    """Cameras that are far worse than the median of the others, worst first.

    Arguments:
        inside, covered: camera to the shares of `Alignment`.
    """
    if len(inside) < 3:
        return []
    middle, cover = float(np.median(list(inside.values()))), float(np.median(list(covered.values())))
    worse = [
        name for name in inside if inside[name] < middle - _WORSE or covered[name] < _LESS_COVERED * cover
    ]
    return sorted(worse, key=lambda name: inside[name])


def likely_cause(take: Take, name: str, scenes: Scenes) -> str:
    """What would make the masks of a camera fit, as the end of a sentence; "" where nothing tried does."""
    camera = take.camera(name)
    masks = {frame: small_mask(take, name, frame) for frame in scenes if take.has_image(name, frame)}
    shown = {frame: mask for frame, mask in masks.items() if mask is not None}
    if not shown:
        return "its masks are empty"
    if min(float(mask.mean()) for mask in shown.values()) > _WHITE:
        return "its masks are white all over"
    best, least = "", _mean_iou(scenes, camera, shown) + _GAIN
    for cause, iou in _hypotheses(take, camera, shown, scenes):
        if iou > least:
            best, least = cause, iou
    return best


def global_cause(take: Take, masks: Mapping[tuple[str, int], Mask], scenes: Scenes) -> str:
    """What would make the masks of all cameras fit; "" where nothing tried does."""

    def score(change: float | None = None, shift: int = 0, inverted: bool = False) -> float:
        values = []
        for (name, frame), mask in masks.items():
            camera = take.camera(name)
            other: Mask | None = mask
            if shift:
                other = small_mask(take, name, frame + shift) if take.has_image(name, frame + shift) else None
            if other is None:
                continue
            camera = camera if change is None else _focal(camera, change)
            values.append(_iou(silhouette(scenes[frame], camera), ~other if inverted else other))
        return float(np.mean(values)) if values else 0.0

    least = score() + _GAIN
    best = ""
    tried = [("the masks are inverted: the person is black in them", score(inverted=True))]
    tried += [(_shift_words("the poses", shift), score(shift=shift)) for shift in _SHIFTS]
    tried += [(_focal_words("the focal lengths", factor), score(change=factor)) for factor in _FOCALS]
    for cause, iou in tried:
        if iou > least:
            best, least = cause, iou
    return best


def label_warnings(take: Take, frame: int) -> list[str]:
    """Cameras whose label images mark what is outside their masks."""
    off = []
    labelled = [name for name in take.training_cameras if take.has_image(name, frame)]
    for name in labelled[:_LABELS_READ]:
        labels = take.labels(name, frame)
        if labels is None or not (labels != 255).any():
            continue
        outside = float((take.mask(name, frame)[labels != 255] <= MASK_THRESHOLD).mean())
        if outside > _LABELLED_OUTSIDE:
            off.append(f"{name} {100 * outside:.0f} %")
    if not off:
        return []
    return [
        f"label images mark pixels outside the masks in frame {frame} ({', '.join(off)} of what they mark): "
        "the background must be 255, and both must be of the same frame."
    ]


def _hypotheses(
    take: Take, camera: Camera, masks: Mapping[int, Mask], scenes: Scenes
) -> Iterator[tuple[str, float]]:
    """Causes, each with the intersection over union that its cure would have."""
    yield "its masks are inverted", _mean_iou(scenes, camera, {frame: ~mask for frame, mask in masks.items()})
    for other in take.cameras.values():
        if other.name != camera.name:
            placed = replace(camera, camera_from_world=other.camera_from_world)
            yield (
                f"its extrinsics seem to be exchanged: those of {other.name} fit",
                (_mean_iou(scenes, placed, masks)),
            )
    for shift in _SHIFTS:
        moved = {
            frame: small_mask(take, camera.name, frame + shift)
            for frame in masks
            if take.has_image(camera.name, frame + shift)
        }
        shown = {frame: mask for frame, mask in moved.items() if mask is not None}
        if shown:
            yield _shift_words("its poses", shift), _mean_iou(scenes, camera, shown)
    for factor in _FOCALS:
        yield _focal_words("its focal length", factor), _mean_iou(scenes, _focal(camera, factor), masks)


def _shift_words(what: str, shift: int) -> str:
    """Poses of frame f fit the masks of frame f + shift."""
    return f"{what} seem to be {abs(shift)} frames {'early' if shift > 0 else 'late'} for the images"


def _focal_words(what: str, factor: float) -> str:
    return (
        f"{what} seem off: {factor:g} times as long fits"
        if what.endswith("s")
        else (f"{what} seems off: {factor:g} times as long fits")
    )


def _focal(camera: Camera, factor: float) -> Camera:
    return replace(
        camera, intrinsics=camera.intrinsics * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    )


def _mean_iou(scenes: Scenes, camera: Camera, masks: Mapping[int, Mask]) -> float:
    return float(np.mean([_iou(silhouette(scenes[frame], camera), mask) for frame, mask in masks.items()]))


def _iou(a: Mask, b: Mask) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))

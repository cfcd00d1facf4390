"""The pictures, masks and contact sheet of an import."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.import_capture.config import ImportConfig
from stages.import_capture.frames import camera_frames
from stages.import_capture.prepare import ImportSource
from stages.import_capture.sheet import camera_sheet
from stages.shared.capture import Camera
from stages.shared.capture.landmarks import COUNT
from stages.shared.capture.native_writer import TakeWriter
from stages.shared.errors import BadData
from stages.shared.report import Report
from stages.shared.vision.consistency import consistent_masks
from stages.shared.vision.edges import largest_person, sharpened_mask
from stages.shared.vision.people import PersonFinder

_Image = NDArray[np.uint8]
Doubles = NDArray[np.float64]


@dataclass(eq=False)
class Collected:
    """What the first pass over the pictures leaves: masks as PNG, landmarks by camera and row."""

    masks: dict[tuple[str, int], bytes] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    pixels: Doubles = field(default_factory=lambda: np.empty(0))
    visibility: Doubles = field(default_factory=lambda: np.empty(0))


def write_pictures(prepared: ImportSource, takes: list[tuple[TakeWriter, int]], report: Report) -> Collected:
    """Undistort and write all pictures; keep their masks and landmarks."""
    report.step(f"reading {prepared.rows} frames of {len(prepared.recordings)} cameras")
    finder = PersonFinder() if prepared.landmarks else None
    shape = (len(prepared.recordings), prepared.rows, COUNT)
    collected = Collected(pixels=np.full((*shape, 2), np.nan), visibility=np.zeros(shape))
    done = 0
    for number, (name, recording) in enumerate(prepared.recordings.items()):
        lossless = bool(recording.files) and recording.files[0].suffix.lower() not in (".jpg", ".jpeg")
        for frame in camera_frames(
            name, recording, prepared.table[name], prepared.lenses[name], prepared.masks, finder
        ):
            take, place = takes[frame.row]
            take.picture(name, place, frame.image, jpeg=not lossless)
            if frame.mask is None or int(frame.mask.max()) <= 127:
                collected.missing.append(f"{name} frame {frame.row}")
            else:
                collected.masks[name, frame.row] = cv2.imencode(".png", frame.mask)[1].tobytes()
            if frame.person is not None:
                collected.pixels[number, frame.row] = frame.person.pixels
                collected.visibility[number, frame.row] = frame.person.visibility
            done += 1
            report.progress(done, prepared.rows * len(prepared.recordings))
    if collected.missing:
        some = ", ".join(collected.missing[:4])
        report.warn(f"{len(collected.missing)} pictures show no person and are left out: {some}")
    if not collected.masks:
        raise BadData(
            "No picture shows a person.", f"masks by {prepared.masks.kind}", "Check the pictures and masks."
        )
    return collected


def write_masks(
    prepared: ImportSource,
    takes: list[tuple[TakeWriter, int]],
    cameras: Sequence[Camera],
    collected: Collected,
    points: Doubles | None,
    config: ImportConfig,
    report: Report,
) -> None:
    """Masks that agree with each other, with edges of the picture; those of a folder or alpha stay."""
    report.step("making masks")
    exact = prepared.masks.kind in ("folder", "alpha")
    for row, (take, place) in enumerate(takes):
        shown = [camera for camera in cameras if (camera.name, row) in collected.masks]
        masks = [_decoded(collected.masks[camera.name, row]) for camera in shown]
        if not exact:
            masks = [largest_person(mask) for mask in masks]
            masks = consistent_masks(shown, masks, None if points is None else points[row])
            if config.sharp_edges:
                masks = [
                    sharpened_mask(_written_picture(take, camera.name, place), mask)
                    for camera, mask in zip(shown, masks, strict=True)
                ]
        for camera, mask in zip(shown, masks, strict=True):
            take.mask(camera.name, place, mask)
        report.progress(row + 1, len(takes))


def contact_sheet(
    takes: list[tuple[TakeWriter, int]],
    cameras: Sequence[Camera],
    points: Doubles | None,
    numbers: Mapping[str, float],
    collected: Collected,
) -> bytes:
    pictures, captions = {}, {}
    for camera in cameras:
        row = next((row for row in range(len(takes)) if (camera.name, row) in collected.masks), None)
        if row is None:
            continue
        take, place = takes[row]
        path = take.folder / "masks" / camera.name / f"{place:06d}.png"
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        pictures[camera.name] = (_written_picture(take, camera.name, place), np.asarray(mask, np.uint8))
        error = numbers.get(camera.name)
        captions[camera.name] = camera.name if error is None else f"{camera.name}  {error:.1f} px"
    sheet = camera_sheet(cameras, pictures, captions, None if points is None else points[0])
    return bytes(cv2.imencode(".png", sheet[..., ::-1])[1].tobytes())


def _written_picture(take: TakeWriter, camera: str, frame: int) -> _Image:
    folder = take.folder / "rgb" / camera
    path = next(folder / f"{frame:06d}{suffix}" for suffix in (".png", ".jpg")
                if (folder / f"{frame:06d}{suffix}").is_file())  # fmt: skip
    return np.ascontiguousarray(np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR))[..., ::-1], np.uint8)


def _decoded(data: bytes) -> _Image:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint8)

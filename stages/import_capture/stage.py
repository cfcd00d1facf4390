"""`gw import`: videos or pictures with a calibration become a capture in the native layout.

Reads:
    videos, folders of pictures, or a picture a camera; a calibration (`stages.shared.calibration`); masks,
    or a picture of the empty scene, where there are some
Writes, whole or absent:
    a native capture (docs/formats.md): undistorted pictures u8 sRGB, masks u8, pinhole cameras; world in
    metres, y up; `takes/<name>/landmarks.npz` where networks are installed
    contact_sheet.png   cameras from above and from the side, a picture of each with the outline of its mask
    import.json         what was read, assumed and measured
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.import_capture.config import ImportConfig
from stages.import_capture.prepare import ImportSource, prepare
from stages.import_capture.refine import refined_cameras
from stages.import_capture.world import World, find_world, stature
from stages.import_capture.write import Collected, contact_sheet, write_masks, write_pictures
from stages.shared.capture import Camera, native_writer
from stages.shared.capture.landmarks import FILE, Landmarks
from stages.shared.capture.native_writer import NativeWriter, TakeWriter
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report
from stages.shared.targets import check_folder_target
from stages.shared.vision.triangulate import Triangulated, triangulate

_Image = NDArray[np.uint8]
Doubles = NDArray[np.float64]

TEST = "_test"
_BAD_SHARE = 0.02  # of the person's height in pixels: a camera that is off by more is named
_EXCHANGED_SHARE = 0.3
_SECONDS_A_PICTURE = 0.5


@dataclass(frozen=True)
class ImportResult:
    """The capture's folder and what is worth reading about it."""

    path: Path
    summary: dict[str, Any]


def run(
    source: Path,
    output: Path,
    config: ImportConfig = ImportConfig(),
    report: Report = SILENT,
    calibration: Path | None = None,
) -> ImportResult:
    """Write the native capture of a folder of recordings.

    Arguments:
        calibration: file or folder; None looks for one in the source.

    Raises:
        MissingInput: no recordings, no calibration, nothing to make masks from.
        BadData: damaged files, sizes that do not agree, a unit that cannot be told.
        UsageProblem: an option that cannot be meant.
    """
    prepared = prepare(source, config, calibration)
    check_folder_target(output)
    for note in prepared.notes:
        report.say(note)
    names = list(prepared.lenses)
    distorted_world = [prepared.lenses[name].camera for name in names]
    with native_writer(output, distorted_world, config.held_out) as writer:
        takes = _takes(writer, config, prepared)
        collected = write_pictures(prepared, takes, report)
        cameras, result, numbers = _cameras(prepared, collected, config, report)
        world = find_world(
            prepared.calibration,
            dict(zip(names, cameras, strict=True)),
            None if result is None else result.points,
            config.up,
            config.metres_per_unit,
        )
        for note in world.notes:
            report.say(note)
        cameras = [world.camera(camera) for camera in cameras]
        writer.replace_cameras(cameras, config.held_out)
        points = None if result is None else world.points(result.points)
        write_masks(prepared, takes, cameras, collected, points, config, report)
        if result is not None and points is not None:
            _write_landmarks(takes, names, collected, points, result)
        summary = _summary(prepared, cameras, world, result, points, numbers, config)
        writer.notes = {"source": "gw import", "frames_per_second": prepared.fps}
        writer.extra("import.json", (json.dumps(summary, indent=1) + "\n").encode())
        writer.extra("contact_sheet.png", contact_sheet(takes, cameras, points, numbers, collected))
    return ImportResult(output, summary)


def plan(
    source: Path, output: Path, config: ImportConfig = ImportConfig(), calibration: Path | None = None
) -> Plan:
    """What `run` would read, write and cost."""
    prepared = prepare(source, config, calibration)
    check_folder_target(output)
    pictures = prepared.rows * len(prepared.recordings)
    pixels = sum(lens.camera.width * lens.camera.height for lens in prepared.lenses.values())
    return Plan(
        inputs=[str(one.path) for one in prepared.recordings.values()] + list(prepared.calibration.files),
        outputs=[str(output)],
        config={
            "calibration": prepared.calibration.kind,
            "cameras": len(prepared.recordings),
            "frames": prepared.rows,
            "frames_per_second": prepared.fps,
            "masks": prepared.masks.kind,
            "landmarks": prepared.landmarks,
        },
        seconds=_SECONDS_A_PICTURE * pictures,
        memory_bytes=500_000_000 + 12 * pixels,
        disk_bytes=prepared.rows * pixels // 3,
    )


def _takes(
    writer: NativeWriter, config: ImportConfig, prepared: ImportSource
) -> list[tuple[TakeWriter, int]]:
    """For every row of the recordings its take and its frame there."""
    train = writer.take(config.take, "train", None)
    writer.takes[-1]["fps"] = prepared.fps
    count = prepared.rows - config.test_frames
    rows = [(train, row) for row in range(count)]
    if config.test_frames:
        test = writer.take(config.take + TEST, "test", None)
        writer.takes[-1]["fps"] = prepared.fps
        rows += [(test, row) for row in range(config.test_frames)]
    return rows


def _cameras(
    prepared: ImportSource, collected: Collected, config: ImportConfig, report: Report
) -> tuple[list[Camera], Triangulated | None, dict[str, float]]:
    """Pinholes in the calibration's world, refined if asked for, with landmarks and errors in pixels."""
    cameras = [lens.camera for lens in prepared.lenses.values()]
    if not prepared.landmarks or len(cameras) < 2:
        return cameras, None, {}
    result = triangulate(cameras, collected.pixels, collected.visibility)
    if config.refine_cameras:
        before = float(np.nanmedian(result.pixels))
        report.step("refining the cameras by landmarks")
        cameras = refined_cameras(cameras, collected.pixels, collected.visibility)
        result = triangulate(cameras, collected.pixels, collected.visibility)
        after = float(np.nanmedian(result.pixels))
        report.say(f"the cameras are refined: landmarks agree to {after:.1f} px, before to {before:.1f} px")
    numbers = {}
    for number, camera in enumerate(cameras):
        error = result.pixels[number]
        if not np.isfinite(error).any():
            continue
        numbers[camera.name] = float(np.nanmedian(error))
        rows = np.nanmax(collected.pixels[number, ..., 1], axis=1) - np.nanmin(
            collected.pixels[number, ..., 1], axis=1
        )
        if numbers[camera.name] > _BAD_SHARE * np.nanmedian(rows):
            report.warn(
                f"{camera.name}: landmarks are {numbers[camera.name]:.0f} px from where the other cameras "
                "see them; check its calibration and its sync, or try --refine-cameras"
            )
        if result.swapped[number].mean() > _EXCHANGED_SHARE:
            report.say(f"{camera.name}: left and right were exchanged; the person is seen from behind")
    return cameras, result, numbers


def _write_landmarks(
    takes: list[tuple[TakeWriter, int]],
    names: Sequence[str],
    collected: Collected,
    points: Doubles,
    result: Triangulated,
) -> None:
    for take in dict.fromkeys(take for take, _ in takes):
        rows = [row for row, (one, _) in enumerate(takes) if one is take]
        landmarks = Landmarks(
            tuple(names),
            np.arange(len(rows)),
            collected.pixels[:, rows].astype(np.float32),
            collected.visibility[:, rows].astype(np.float32),
            points[rows].astype(np.float32),
            result.views[rows],
        )
        take.extra(FILE, landmarks.encoded())


def _summary(
    prepared: ImportSource,
    cameras: Sequence[Camera],
    world: World,
    result: Triangulated | None,
    points: Doubles | None,
    numbers: dict[str, float],
    config: ImportConfig,
) -> dict[str, Any]:
    centres = np.stack([camera.centre for camera in cameras])
    summary: dict[str, Any] = {
        "calibration": prepared.calibration.kind,
        "cameras": len(cameras),
        "frames": prepared.rows,
        "frames_per_second": prepared.fps,
        "masks": prepared.masks.kind,
        "metres_per_unit": world.metres,
        "world_from_calibration": world.turn.tolist(),
        "camera_distance_m": float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1))),
        "notes": [*prepared.notes, *world.notes],
    }
    if result is not None and points is not None:
        summary["landmark_error_px"] = float(np.nanmedian(result.pixels))
        summary["landmark_error_px_by_camera"] = numbers
        summary["stature_m"] = stature(points)
        summary["refined_cameras"] = config.refine_cameras
    return summary

"""A capture with virtual cameras, rendered from the scans of every frame."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from stages.shared.artifacts.canonical import digest
from stages.shared.capture import Capture, Take, native_writer
from stages.shared.capture.textured_scan import read_textured_scan, render_scan, ring_of_cameras
from stages.shared.errors import MissingInput
from stages.shared.meshes.ply import encode_ply
from stages.shared.report import Report

WIDTH, HEIGHT = 940, 1280  # pixels, as the data set's own cameras
_MARGIN_M = 1.1  # around the pelvis, for arms and legs
_MADE_OF = "made_of.json"


def virtual_capture(
    capture: Capture,
    folder: Path,
    count: int,
    report: Report,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    force: bool = False,
) -> Path:
    """Write a native capture at `folder`: `count` cameras around the scans of every frame; give its path.

    It is whole or absent. One that was made of the same scans, poses and settings is left as it is.

    Arguments:
        capture: with poses, and a scan of every frame to be used (`Take.scans`).
        size: width and height of the pictures, pixels.

    Raises:
        MissingInput: no take has scans.
    """
    takes = takes_with_scans(capture)
    made_of = _made_of(capture, takes, count, size, folder)
    note = folder / _MADE_OF
    if not force and note.is_file() and note.read_bytes() == made_of:
        report.say(f"the virtual cameras in {folder} are up to date")
        return folder
    report.step(f"rendering {count} virtual cameras around the scans")
    pelvis = np.concatenate([take.poses.translation for take in takes])
    cameras = ring_of_cameras(pelvis.min(axis=0) - _MARGIN_M, pelvis.max(axis=0) + _MARGIN_M, count, *size)
    total = sum(len(take.scans) for take in takes)
    done = 0
    with native_writer(folder, cameras) as writer:
        writer.extra(_MADE_OF, made_of)
        for take in takes:
            first = min(take.scans)
            written = writer.take(take.name, take.split, take.poses, first)
            for frame, path in sorted(take.scans.items()):
                scan = read_textured_scan(path)
                if frame == first:
                    written.scan(b"".join(encode_ply(scan.mesh)))
                for camera in cameras:
                    image, mask, labels = render_scan(scan, camera)
                    written.view(camera.name, frame, image, mask, labels)
                done += 1
                report.progress(done, total)
    return folder


def takes_with_scans(capture: Capture) -> list[Take]:
    """The takes that have scans; MissingInput where there are none."""
    takes = [take for take in capture.takes if take.scans]
    if not takes:
        raise MissingInput(
            "Virtual cameras need a scan of every frame, and the capture has none.",
            str(capture.root),
            "Leave --virtual-cameras out, or copy the folder Meshes_pkl.",
        )
    return takes


def _made_of(capture: Capture, takes: list[Take], count: int, size: tuple[int, int], folder: Path) -> bytes:
    """What a virtual capture depends on, as JSON: sizes and times of the scans, the poses, the settings.

    The path of the capture is relative to `folder`, so that no file holds an absolute path.
    """
    scans = {
        f"{take.name}/{frame}": [path.name, path.stat().st_size, path.stat().st_mtime_ns]
        for take in takes
        for frame, path in sorted(take.scans.items())
    }
    poses = {take.name: digest(take.poses.to_npz_bytes()) for take in takes}
    place = Path(os.path.relpath(capture.root.resolve(), folder.resolve())).as_posix()
    content = {"capture": place, "cameras": count, "size": size}
    return (json.dumps({**content, "scans": scans, "poses": poses}, sort_keys=True) + "\n").encode()

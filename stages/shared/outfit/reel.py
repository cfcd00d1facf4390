"""An outfit through a motion: every frame by every camera, into files, one frame in memory at a time.

Writes, below a folder:
    frames/[CAMERA/]RRRRRR.png    (H,W,4) u8 sRGB with straight alpha; RRRRRR is the row of the pose file
    labels/[CAMERA/]RRRRRR.png    (H,W) u8 label ids, 255 none               (pass "labels")
    depth/[CAMERA/]RRRRRR.png     (H,W) u16 millimetres, 0 none              (pass "depth")
    layers/LAYER/[CAMERA/]RRRRRR.png   (H,W,4) u8, each layer alone          (pass "layers")
    FORMAT/frameRRRRRR.FORMAT     the posed Gaussians (exports "ply", "spz", "glb"), and export_notes.json
    NAME.mp4 or NAME.webm         the first camera's film; contact_sheet.png
    records/RRRRRR.json           of every finished frame; whoever closes the folder removes them

Film and contact sheet are made from the frames in the folder, so it does not matter in how many runs, or by
whom, those were rendered.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.artifacts.canonical import KEY_LENGTH, canonical_json, digest
from stages.shared.artifacts.files import write_whole
from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.export.notes import NOTES_NAME, write_notes
from stages.shared.outfit.hidden import LEAST_PICTURES, plan_hidden
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.picture import take_picture
from stages.shared.outfit.playback import side_by_side, threads_restored
from stages.shared.outfit.player import Player
from stages.shared.outfit.reel_config import ReelConfig, ReelFrame, ReelSummary
from stages.shared.outfit.reel_files import picture_name, write_exports, write_film, write_sheet, write_shot
from stages.shared.pictures.parts import RECORDS, Share
from stages.shared.report import Report

_CODE_VERSION = 2  # raised when the same inputs give other files


def reel_key(
    outfit: Outfit, digests: Mapping[str, str], poses: Poses, frames: Sequence[ReelFrame], config: Any
) -> str:
    """Names the content of a reel: the same key, the same files.

    Arguments:
        digests: of what the outfit was read from. config: the stage's whole configuration.
    """
    seen = hashlib.sha256()
    for array in (poses.rotations, poses.translation, outfit.betas):
        seen.update(np.ascontiguousarray(array).tobytes())
    for frame in frames:
        for camera in frame.cameras:
            seen.update(f"{frame.row} {camera.name} {camera.width} {camera.height} ".encode())
            seen.update(camera.intrinsics.tobytes() + camera.camera_from_world.tobytes())
    parts = {"code": _CODE_VERSION, "config": config, "digests": digests, "seen": seen.hexdigest()}
    return digest(canonical_json(parts))[:KEY_LENGTH]


def write_frames(
    folder: Path,
    outfit: Outfit,
    poses: Poses,
    frames: Sequence[ReelFrame],
    config: ReelConfig,
    report: Report,
    share: Share = Share(),
) -> int:
    """Render a share of the frames, those that are finished already left out; returns how many were left out.

    A frame is finished when its record is there, which is written last. As many frames are made at a time as
    torch uses threads; memory does not grow with their number. An interrupt lets the frames at work finish.

    Arguments:
        folder: a folder for this reel alone (`stages/shared/pictures/parts.py`).
        poses: rows as `frames` name them.

    Raises:
        UsageProblem: a row that the poses do not have. StorageFailure: disk full.
    """
    last = max((frame.row for frame in frames), default=-1)
    if last >= len(poses):
        raise UsageProblem(
            f"Frame {last} is asked for, but there are poses for {len(poses)} frames only.",
            "poses and cameras",
            "Give the motion that belongs to the cameras, or fewer frames.",
        )
    mine = share.of(frames)
    missing = [frame for frame in mine if not _record(folder, frame.row).exists()]
    at_a_time = max(1, min(torch.get_num_threads(), len(missing)))

    def work(player: Player, frame: ReelFrame) -> None:
        counted = _write_frame(folder, player, poses, frame, config)
        counted.wall = counted.rendering / at_a_time
        write_whole(_record(folder, frame.row), canonical_json(asdict(counted)))

    with threads_restored():
        torch.set_num_threads(1)  # a frame's rounding must not depend on how many are left to render
        hidden = _hidden(outfit, poses, frames, config) if missing else None
        with closing(side_by_side(outfit, missing, work, at_a_time, hidden)) as done:
            for index, _ in enumerate(done):
                report.progress(index + 1, len(missing))
    return len(mine) - len(missing)


def _hidden(
    outfit: Outfit, poses: Poses, frames: Sequence[ReelFrame], config: ReelConfig
) -> NDArray[np.bool_] | None:
    """The body's texels that are left out of all frames, whichever of them are this run's."""
    pictures = sum(len(frame.cameras) for frame in frames)
    whole = bool(config.exports) or "layers" in config.passes or not config.pictures
    if not config.cull or whole or pictures < LEAST_PICTURES:
        return None
    return plan_hidden(outfit, poses, [frame.row for frame in frames])


def close_reel(
    folder: Path, outfit: Outfit, poses: Poses, frames: Sequence[ReelFrame], config: ReelConfig
) -> ReelSummary:
    """Film, contact sheet and export notes out of finished frames, and the sum of their records."""
    summary = ReelSummary()
    for frame in frames:
        summary.add(ReelSummary(**json.loads(_record(folder, frame.row).read_bytes())))
    started = time.perf_counter()
    for kind in config.exports:
        more = {"layers": list(outfit.names), "frames_per_second": poses.fps, "gaussians": outfit.gaussians}
        write_notes(folder / kind / NOTES_NAME, kind, "world, posed", **more)
    if config.pictures:
        summary.video = write_film(folder, poses.fps, frames, config)
        write_sheet(folder, frames, config)
    summary.clock("film", started)
    return summary


def _write_frame(
    folder: Path, player: Player, poses: Poses, frame: ReelFrame, config: ReelConfig
) -> ReelSummary:
    """All files of one moment, and what was counted."""
    counted = ReelSummary()
    started = time.perf_counter()
    composite = player.composite(poses, frame.row)
    counted.clock("pose", started)
    if config.exports:
        started = time.perf_counter()
        write_exports(folder, composite, frame.row, config.exports)
        counted.clock("export", started)
    for camera in frame.cameras if config.pictures else ():
        started = time.perf_counter()
        layers = "layers" in config.passes
        shot = take_picture(composite, camera, config.penetration, layers, cutoffs=config.cutoffs)
        counted.clock("render", started)
        counted.add(ReelSummary(pictures=1, penetrated=shot.counts))
        started = time.perf_counter()
        write_shot(folder, shot, picture_name(frame.row, camera, config), config.passes)
        counted.clock("write", started)
    return counted


def _record(folder: Path, row: int) -> Path:
    return folder / RECORDS / f"{row:06d}.json"

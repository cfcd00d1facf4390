"""Renders the frames of a sequence into files, one frame in memory at a time, and assembles them.

Writes, below a folder:
    frames/[CAMERA/]RRRRRR.png    (H,W,4) u8 sRGB with straight alpha; RRRRRR is the row of the pose file
    labels/[CAMERA/]RRRRRR.png    (H,W) u8 label ids, 255 none               (pass "labels")
    depth/[CAMERA/]RRRRRR.png     (H,W) u16 millimetres, 0 none              (pass "depth")
    layers/LAYER/[CAMERA/]RRRRRR.png   (H,W,4) u8, each layer alone          (pass "layers")
    FORMAT/frameRRRRRR.FORMAT     the posed Gaussians (exports "ply", "spz", "glb"), and export_notes.json
    NAME.mp4 or NAME.webm         video of the first camera; contact_sheet.png
    records/RRRRRR.json           one per finished frame; removed when the folder gets its final name

Video and contact sheet are made from the frames in the folder, whichever runs rendered those.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.artifacts.canonical import canonical_json
from stages.shared.artifacts.files import write_whole
from stages.shared.body import Poses
from stages.shared.errors import UsageProblem
from stages.shared.export.notes import NOTES_NAME, axes_text, write_notes
from stages.shared.export.splats import up_of
from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.parallel_frames import parallel_frames, threads_restored
from stages.shared.outfit.render_image import render_image
from stages.shared.outfit.visibility_culling import LEAST_PICTURES, find_hidden_texels
from stages.shared.pictures.parts import RECORDS, Share
from stages.shared.render_sequence.files import (
    picture_name,
    write_exports,
    write_passes,
    write_sheet,
    write_video,
)
from stages.shared.render_sequence.outputs import (
    SequenceFrame,
    SequenceOutputs,
    SequenceSummary,
    frames_at_a_time,
    video_rate,
)
from stages.shared.report import Report


def write_frames(
    folder: Path,
    outfit: Outfit,
    poses: Poses,
    frames: Sequence[SequenceFrame],
    outputs: SequenceOutputs,
    report: Report,
    share: Share = Share(),
) -> int:
    """Render a share of the frames that are not finished yet; returns how many were finished before.

    A frame is finished when its record is there, which is written last. As many frames are rendered at a time
    as torch uses threads; memory does not grow with their number. After an interrupt the frames in work are
    finished.

    Arguments:
        folder: a folder for this sequence alone (`stages/shared/pictures/parts.py`).
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
    frames_of_share = share.of(frames)
    missing = [frame for frame in frames_of_share if not _record(folder, frame.row).exists()]
    threads = min(torch.get_num_threads(), len(missing))
    at_a_time = frames_at_a_time(threads, missing, len(outfit.names), outputs)

    def work(player: CachedPoser, frame: SequenceFrame) -> None:
        counts = _write_frame(folder, player, poses, frame, outputs)
        counts.wall = counts.rendering / at_a_time
        write_whole(_record(folder, frame.row), canonical_json(asdict(counts)))

    with threads_restored():
        torch.set_num_threads(1)  # a frame's rounding must not depend on how many are left to render
        outfit.prepare(poses, sorted(frame.row for frame in missing))
        hidden = _hidden_texels(outfit, poses, frames, outputs) if missing else None
        with closing(parallel_frames(outfit, missing, work, at_a_time, hidden)) as results:
            for index, _ in enumerate(results):
                report.progress(index + 1, len(missing))
    return len(frames_of_share) - len(missing)


def assemble(
    folder: Path, outfit: Outfit, poses: Poses, frames: Sequence[SequenceFrame], outputs: SequenceOutputs
) -> SequenceSummary:
    """Video, contact sheet and export notes from finished frames; returns the sum of their records."""
    summary = SequenceSummary()
    for frame in frames:
        summary.add(SequenceSummary(**json.loads(_record(folder, frame.row).read_bytes())))
    started, rate = time.perf_counter(), video_rate(poses.fps, frames)
    for kind in outputs.exports:
        more = {"layers": list(outfit.names), "frames_per_second": rate, "gaussians": outfit.gaussians}
        axes = axes_text(up_of(kind, outputs.up))
        write_notes(folder / kind / NOTES_NAME, kind, "world, posed", axes=axes, **more)
    if outputs.pictures:
        summary.video = write_video(folder, rate, frames, outputs)
        write_sheet(folder, frames, outputs)
    summary.clock("film", started)
    return summary


def _hidden_texels(
    outfit: Outfit, poses: Poses, frames: Sequence[SequenceFrame], outputs: SequenceOutputs
) -> NDArray[np.bool_] | None:
    """The body texels that are left out of all frames; the same for every shard."""
    pictures = sum(len(frame.cameras) for frame in frames)
    body_alone = bool(outputs.exports) or "layers" in outputs.passes or not outputs.pictures
    if not outputs.cull or body_alone or pictures < LEAST_PICTURES:
        return None
    return find_hidden_texels(outfit, poses, [frame.row for frame in frames])


def _write_frame(
    folder: Path, player: CachedPoser, poses: Poses, frame: SequenceFrame, outputs: SequenceOutputs
) -> SequenceSummary:
    """All files of one moment, and their counts."""
    counts = SequenceSummary()
    started = time.perf_counter()
    composite = player.composite(poses, frame.row)
    counts.clock("pose", started)
    if outputs.exports:
        started = time.perf_counter()
        write_exports(folder, composite, frame.row, outputs.exports, outputs.up)
        counts.clock("export", started)
    for camera in frame.cameras if outputs.pictures else ():
        started = time.perf_counter()
        each_layer = "layers" in outputs.passes
        shot = render_image(composite, camera, outputs.penetration, each_layer, settings=outputs.splatting)
        counts.clock("render", started)
        counts.add(SequenceSummary(pictures=1, penetrated=shot.counts))
        started = time.perf_counter()
        write_passes(folder, shot, picture_name(frame.row, camera, outputs), outputs.passes)
        counts.clock("write", started)
    return counts


def _record(folder: Path, row: int) -> Path:
    return folder / RECORDS / f"{row:06d}.json"

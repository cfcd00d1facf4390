"""The run behind `gw tryon` and `gw render`: an outfit in a motion, seen by cameras, into a folder.

Reads:
    `.gwg` bundles, or a SUBJECT (register-template, bake-maps, train artifacts); a pose file; for a capture's
    cameras its calibration and the list of its images; or a camera path (`camera_path.py`).
Writes, into the output folder:
    frames, passes and exports as `frames.py` says, one folder per camera for a capture's cameras;
    NAME.mp4 (or .webm), contact_sheet.png, result.json.
    Until all frames are there the folder is called `.OUT.part-KEY`. A run that was killed continues in it,
    and shards share it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.shared.artifacts.canonical import readable_json, to_json
from stages.shared.artifacts.files import write_whole
from stages.shared.errors import UsageProblem
from stages.shared.export.splats import check_formats, up_of
from stages.shared.outfit.penetration import TRYON_MARGINS, PenetrationConfig
from stages.shared.pictures.background import read_background
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.pictures.video import chosen_suffix
from stages.shared.plan import Plan
from stages.shared.render_sequence.config import RenderConfig
from stages.shared.render_sequence.frames import assemble, write_frames
from stages.shared.render_sequence.outputs import (
    SequenceOutputs,
    SequenceSummary,
    check_passes,
    memory_bytes,
    require_frame,
    video_rate,
)
from stages.shared.render_sequence.sequence import RenderSequence, open_sequence
from stages.shared.report import SILENT, Report
from stages.shared.splat.settings import SplatSettings

RESULT_NAME = "result.json"


@dataclass(frozen=True)
class Command:
    """What tells the two commands apart on disk: the format name in result.json, and the video's name."""

    mark: str
    video_name: str


RENDER = Command("gw-render", "film")
TRYON = Command("gw-tryon", "tryon")


@dataclass(frozen=True)
class RenderResult:
    """The output folder and a summary. complete: the folder has its final name; false after a shard."""

    path: Path
    summary: dict[str, Any]
    complete: bool = True


def run(
    command: Command,
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
    report: Report = SILENT,
) -> RenderResult:
    """Render and write; frames that an earlier run of the same content finished are not rendered again.

    Arguments:
        sources: one subject folder, or bundles: one body and any garments.
        poses_path: None for the subject's own poses or the capture's; "canonical" for the pose of the maps.
        cameras_path: a capture whose cameras are used; None for a camera path.

    Raises:
        UsageProblem: options that exclude each other, no body or two, two garments for one slot, an output
            folder that holds something else. MissingInput, BadData: inputs.
        StorageFailure: disk full; the same command continues later. Locked: another process renders the same.
    """
    outputs, share = _outputs(command, config, sources, cameras_path is not None), parse_share(config.shard)
    check_output(output, RESULT_NAME, command.mark)
    report.step("reading")
    sequence = open_sequence(sources, poses_path, cameras_path, config, report)
    outfit, poses, frames = sequence.outfit, sequence.poses, sequence.frames
    report.say(f"{' < '.join(outfit.names)}: {outfit.gaussians} Gaussians, {len(frames)} frames")
    require_frame(share.of(frames), outfit.gaussians, len(outfit.names), outputs)
    report.step("rendering")
    with part_folder(output, sequence.key(config), share) as folder:
        kept = write_frames(folder, outfit, poses, frames, outputs, report, share)
        if kept:
            report.say(f"{kept} frames were there already")
        if not share.whole:
            count = len(share.of(frames))
            return RenderResult(output, {"shard": config.shard, "frames": count, "kept": kept}, False)
        counts = assemble(folder, outfit, poses, frames, outputs)
        summary = {**_described(sequence), "kept_frames": kept, **counts.as_dict()}
        content = _result(command, sequence, outputs, config, summary)
        write_whole(folder / RESULT_NAME, readable_json(content))
        finish(folder, output, _video_files(folder, counts))
    return RenderResult(output, summary)


def plan(
    command: Command,
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
) -> Plan:
    """What `run` would read, write and cost."""
    outputs, share = _outputs(command, config, sources, cameras_path is not None), parse_share(config.shard)
    check_output(output, RESULT_NAME, command.mark)
    sequence = open_sequence(sources, poses_path, cameras_path, config)
    frames, count = share.of(sequence.frames), sequence.outfit.gaussians
    cameras = [camera for frame in frames for camera in frame.cameras] if config.pictures else []
    pixels = sum(camera.width * camera.height for camera in cameras)
    inputs = [*sources, *(path for path in (poses_path, cameras_path) if path is not None)]
    names = [*outputs.exports, *(("frames", *outputs.passes, "contact_sheet.png") if config.pictures else ())]
    bytes_per_gaussian = {"ply": 68, "spz": 16, "glb": 60}
    export_bytes = len(frames) * count * sum(bytes_per_gaussian[kind] for kind in outputs.exports)
    return Plan(
        inputs=[str(path) for path in inputs],
        outputs=[str(output / name) for name in (*names, RESULT_NAME)],
        config={**asdict(config), "layers": list(sequence.outfit.names)},
        seconds=3.0 + len(cameras) * (0.05 + 3e-6 * count) + 5e-7 * pixels,
        memory_bytes=memory_bytes(frames, count, len(sequence.outfit.names), outputs),
        disk_bytes=int(pixels * 0.4) + export_bytes,
    )


def _outputs(
    command: Command, config: RenderConfig, sources: Sequence[Path], from_capture: bool
) -> SequenceOutputs:
    """What the options ask for, checked."""
    check_passes(config.passes)
    if not math.isfinite(config.turns):
        raise UsageProblem("That is no number of turns.", "option --turns", "Give a number, as 1 or -0.5.")
    check_formats(config.exports, "option --export")
    for kind in config.exports or ("ply",):
        up_of(kind, config.up)
    passes = config.passes
    if from_capture and "labels" not in passes:
        passes = ("labels", *passes)  # `gw evaluate --frames` compares them with the capture's
    margins = PenetrationConfig() if any(path.is_dir() for path in sources) else TRYON_MARGINS
    background = read_background(config.background)
    chosen_suffix(config.video, background.transparent)
    return SequenceOutputs(
        background=background,
        passes=passes,
        penetration=margins if config.penetration else None,
        video_name=command.video_name,
        video=config.video,
        camera_folders=from_capture,
        exports=config.exports,
        up=config.up,
        pictures=config.pictures,
        cull=config.cull,
        splatting=SplatSettings(alpha_min=config.alpha_min, transmittance_min=config.transmittance_min),
    )


def _described(sequence: RenderSequence) -> dict[str, Any]:
    """What was rendered, for the summary and for result.json."""
    outfit = sequence.outfit
    cameras = {camera.name: None for frame in sequence.frames for camera in frame.cameras}
    rows = [frame.row for frame in sequence.frames]
    return {
        "layers": list(outfit.names),
        "gaussians": outfit.gaussians,
        "bundles": sequence.digests,
        "betas": [round(float(value), 6) for value in outfit.betas],
        "swapped_texels": {change.garment: change.count for change in outfit.swaps},
        "restored_texels": outfit.uncovered_skin.count if outfit.uncovered_skin else 0,
        "projected_frames": outfit.projected_frames(sequence.poses, rows),
        "cameras": list(cameras),
        "take": sequence.take.name if sequence.take else None,
    }


def _result(
    command: Command,
    sequence: RenderSequence,
    outputs: SequenceOutputs,
    config: RenderConfig,
    summary: dict[str, Any],
) -> dict[str, Any]:
    """The content of result.json."""
    return {
        "format": command.mark,
        "version": 1,
        "fps": video_rate(sequence.poses.fps, sequence.frames),
        "frames": [frame.row for frame in sequence.frames],
        "passes": list(outputs.passes),
        "exports": list(outputs.exports),
        "camera_folders": outputs.camera_folders,
        "config": to_json(config),
        **summary,
    }


def _video_files(folder: Path, counts: SequenceSummary) -> list[Path]:
    return [] if counts.video is None else [folder / counts.video]

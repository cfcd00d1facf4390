"""Render: a trained subject, or an outfit of bundles, in any motion, seen by any cameras.

Reads:
    SUBJECT (register-template, bake-maps, train artifacts), or `.gwg` bundles; a pose file; for a capture's
    cameras its calibration and the list of its images; or a camera path (`camera_path.py`).
Writes, into the output folder:
    frames, passes and exports as `stages/shared/outfit/reel.py` says, one folder per camera for a capture's
    cameras; film.mp4 (or .webm), contact_sheet.png, result.json.
    Until all frames are there the folder is called `.OUT.part-KEY`; a run that was killed goes on in it, and
    shards share it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.render.config import RenderConfig
from stages.render.scene import Scene, open_scene
from stages.shared.artifacts.canonical import plain, readable_json
from stages.shared.artifacts.files import write_whole
from stages.shared.errors import UsageProblem
from stages.shared.export.splats import check_formats
from stages.shared.outfit.penetration import TRYON_MARGINS, PenetrationConfig
from stages.shared.outfit.picture import CutOffs
from stages.shared.outfit.reel import close_reel, write_frames
from stages.shared.outfit.reel_config import ReelConfig, check_passes
from stages.shared.pictures.background import read_background
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.pictures.video import chosen_suffix
from stages.shared.plan import Plan
from stages.shared.report import SILENT, Report

MARK = "gw-render"
RESULT_NAME = "result.json"


@dataclass(frozen=True)
class RenderResult:
    """The folder, and what happened. complete: the folder has its name; false after a shard."""

    path: Path
    summary: dict[str, Any]
    complete: bool = True


def run(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
    report: Report = SILENT,
) -> RenderResult:
    """Render and write; frames that an earlier run of the same finished are not made again.

    Arguments:
        sources: one subject folder, or bundles.
        poses_path: None: the subject's own, or the capture's; "canonical": the pose of the maps.
        cameras_path: a capture whose cameras look on; None for a camera path.

    Raises:
        UsageProblem: what cannot be meant. MissingInput, BadData: inputs. StorageFailure: disk full.
        Locked: another process renders the same.
    """
    reel, share = _reel_config(config, sources, cameras_path is not None), parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    report.step("reading")
    scene = open_scene(sources, poses_path, cameras_path, config)
    report.say(
        f"{' < '.join(scene.outfit.names)}: {scene.outfit.gaussians} Gaussians, {len(scene.frames)} frames"
    )
    report.step("rendering")
    with part_folder(output, scene.key(config), share) as folder:
        kept = write_frames(folder, scene.outfit, scene.poses, scene.frames, reel, report, share)
        if kept:
            report.say(f"{kept} frames were there already")
        if not share.whole:
            mine = len(share.of(scene.frames))
            return RenderResult(output, {"shard": config.shard, "frames": mine, "kept": kept}, False)
        reel_summary = close_reel(folder, scene.outfit, scene.poses, scene.frames, reel)
        summary = {**_described(scene), "kept_frames": kept, **reel_summary.as_dict()}
        shown = {
            "fps": scene.poses.fps,
            "frames": [frame.row for frame in scene.frames],
            "passes": list(reel.passes),
            "exports": list(reel.exports),
            "camera_folders": reel.camera_folders,
            "config": plain(config),
        }
        write_whole(folder / RESULT_NAME, readable_json({"format": MARK, "version": 1, **shown, **summary}))
        film = [] if reel_summary.video is None else [folder / reel_summary.video]
        finish(folder, output, film)
    return RenderResult(output, summary)


def plan(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
) -> Plan:
    """What `run` would read, write and cost."""
    reel, share = _reel_config(config, sources, cameras_path is not None), parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    scene = open_scene(sources, poses_path, cameras_path, config)
    frames = share.of(scene.frames)
    cameras = [camera for frame in frames for camera in frame.cameras] if config.pictures else []
    pixels = sum(camera.width * camera.height for camera in cameras)
    given = [*sources, *(path for path in (poses_path, cameras_path) if path is not None)]
    names = [*reel.exports, *(("frames", *reel.passes, "contact_sheet.png") if config.pictures else ())]
    exported = {"ply": 68, "spz": 16, "glb": 60}
    stored = len(frames) * scene.outfit.gaussians * sum(exported[kind] for kind in reel.exports)
    return Plan(
        inputs=[str(path) for path in given],
        outputs=[str(output / name) for name in (*names, RESULT_NAME)],
        config={**asdict(config), "layers": list(scene.outfit.names)},
        seconds=3.0 + len(cameras) * (0.05 + 3e-6 * scene.outfit.gaussians) + 5e-7 * pixels,
        memory_bytes=600_000_000 + 3000 * scene.outfit.gaussians + 200 * pixels // max(len(cameras), 1),
        disk_bytes=int(pixels * 0.4) + stored,
    )


def _described(scene: Scene) -> dict[str, Any]:
    """Who was rendered, for people and for result.json."""
    cameras = {camera.name: None for frame in scene.frames for camera in frame.cameras}
    return {
        "layers": list(scene.outfit.names),
        "gaussians": scene.outfit.gaussians,
        "bundles": scene.digests,
        "betas": [round(float(value), 6) for value in scene.outfit.betas],
        "swapped_texels": {change.garment: change.count for change in scene.outfit.swaps},
        "projected_frames": scene.outfit.projected_frames(scene.poses, [frame.row for frame in scene.frames]),
        "cameras": list(cameras),
        "take": scene.take.name if scene.take else None,
    }


def _reel_config(config: RenderConfig, sources: Sequence[Path], from_capture: bool) -> ReelConfig:
    check_passes(config.passes)
    if not math.isfinite(config.turns):
        raise UsageProblem("That is no number of turns.", "option --turns", "Give a number, as 1 or -0.5.")
    check_formats(config.exports, "option --export")
    passes = config.passes
    if from_capture and "labels" not in passes:
        passes = ("labels", *passes)  # `gw evaluate --frames` compares them with the capture's
    margins = PenetrationConfig() if any(path.is_dir() for path in sources) else TRYON_MARGINS
    background = read_background(config.background)
    chosen_suffix(config.video, background.transparent)
    return ReelConfig(
        background=background,
        passes=passes,
        penetration=margins if config.penetration else None,
        film="film",
        video=config.video,
        camera_folders=from_capture,
        exports=config.exports,
        pictures=config.pictures,
        cull=config.cull,
        cutoffs=CutOffs(config.alpha_min, config.transmittance_min),
    )

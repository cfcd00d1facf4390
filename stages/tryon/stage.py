"""Try-on: a body wears garments of other people, in a new motion.

Reads:
    bundles `.gwg`: one body, any garments; a pose file (npz of SMPL-X or AMASS, BVH).
Writes, into the output folder:
    frames/, tryon.mp4 (or .webm), contact_sheet.png, passes as `stages/shared/outfit/reel.py` says;
    result.json: layers, bundles by digest, betas, repaired pixels by pair of layers, swapped texels, seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stages.shared.artifacts.bundle import Bundle
from stages.shared.artifacts.canonical import plain, readable_json
from stages.shared.artifacts.files import write_whole
from stages.shared.body import Poses
from stages.shared.outfit.grounding import grounded
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.penetration import TRYON_MARGINS
from stages.shared.outfit.picture import CutOffs
from stages.shared.outfit.reel import close_reel, reel_key, write_frames
from stages.shared.outfit.reel_config import ReelConfig, ReelFrame, check_passes
from stages.shared.outfit.sources import parse_betas, parse_frames, read_bundles
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.pictures.background import read_background
from stages.shared.pictures.folder import check_output
from stages.shared.pictures.parts import finish, parse_share, part_folder
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report
from stages.tryon.config import TryonConfig

MARK = "gw-tryon"
RESULT_NAME = "result.json"


@dataclass(frozen=True)
class TryonResult:
    """The folder, and what happened. complete: the folder has its name; false after a shard."""

    path: Path
    summary: dict[str, Any]
    complete: bool = True


def run(
    bundles: Sequence[Path],
    poses_path: Path,
    output: Path,
    config: TryonConfig = TryonConfig(),
    report: Report = SILENT,
) -> TryonResult:
    """Dress, pose, render and write.

    Raises:
        UsageProblem: no body or two, two garments for one slot, an output folder that holds something else.
        MissingInput, BadData: bundles and poses. StorageFailure: disk full; the same command goes on later.
        Locked: another process makes the same.
    """
    reel, share = _reel_config(config), parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    report.step("reading the bundles")
    named = read_bundles(bundles)
    outfit = dressed(named, config)
    poses = _motion(poses_path, outfit, config)
    frames = _frames(outfit, poses, config)
    report.say(f"{' < '.join(outfit.names)}: {outfit.gaussians} Gaussians, {len(frames)} frames")
    report.step("rendering")
    digests = {bundle.layer: bundle.digest for _, bundle in named}
    with part_folder(output, reel_key(outfit, digests, poses, frames, config), share) as folder:
        kept = write_frames(folder, outfit, poses, frames, reel, report, share)
        if not share.whole:
            mine = len(share.of(frames))
            return TryonResult(output, {"shard": config.shard, "frames": mine, "kept": kept}, False)
        reel_summary = close_reel(folder, outfit, poses, frames, reel)
        summary = {
            "layers": list(outfit.names),
            "gaussians": outfit.gaussians,
            "bundles": digests,
            "betas": [round(float(value), 6) for value in outfit.betas],
            "swapped_texels": {change.garment: change.count for change in outfit.swaps},
            "restored_texels": outfit.restoration.count if outfit.restoration else 0,
            "projected_frames": outfit.projected_frames(poses, [frame.row for frame in frames]),
            "kept_frames": kept,
            **reel_summary.as_dict(),
        }
        shown = {"fps": poses.fps, "frames": [frame.row for frame in frames], "config": plain(config)}
        content = {"format": MARK, "version": 1, **shown, **summary}
        write_whole(folder / RESULT_NAME, readable_json(content))
        finish(folder, output, [] if reel_summary.video is None else [folder / reel_summary.video])
    return TryonResult(output, summary)


def plan(
    bundles: Sequence[Path], poses_path: Path, output: Path, config: TryonConfig = TryonConfig()
) -> Plan:
    """What `run` would read, write and cost."""
    _reel_config(config)
    share = parse_share(config.shard)
    check_output(output, RESULT_NAME, MARK)
    outfit = dressed(read_bundles(bundles), config)
    poses = _motion(poses_path, outfit, config)
    count = len(share.of(_frames(outfit, poses, config)))
    pixels = config.width * config.height
    return Plan(
        inputs=[*map(str, bundles), str(poses_path)],
        outputs=[str(output / name) for name in ("frames", "contact_sheet.png", RESULT_NAME)],
        config={**asdict(config), "layers": list(outfit.names)},
        seconds=3.0 + count * (0.08 + 3e-6 * outfit.gaussians + 5e-7 * pixels),
        memory_bytes=600_000_000 + 3000 * outfit.gaussians + 200 * pixels,
        disk_bytes=int(count * pixels * 0.4),
    )


def dressed(named: Sequence[tuple[str, Bundle]], config: TryonConfig) -> Outfit:
    """The outfit of these bundles."""
    betas = parse_betas(config.betas)
    return outfit_of_bundles(named, betas, config.swap, config.push, config.restore)


def _motion(path: Path, outfit: Outfit, config: TryonConfig) -> Poses:
    """The motion, with the wearer's feet on its floor."""
    poses = load_poses(path, outfit.body_model, config.fps or None)
    return grounded(poses, outfit.body_model, outfit.betas) if config.ground else poses


def _reel_config(config: TryonConfig) -> ReelConfig:
    check_passes(config.passes)
    return ReelConfig(
        background=read_background(config.background),
        passes=config.passes,
        penetration=TRYON_MARGINS if config.penetration else None,
        film="tryon",
        cull=config.cull,
        cutoffs=CutOffs(config.alpha_min, config.transmittance_min),
    )


def _frames(outfit: Outfit, poses: Poses, config: TryonConfig) -> list[ReelFrame]:
    """Rows of the motion, each with its camera."""
    rows = parse_frames(config.frames, len(poses))
    size = (config.width, config.height)
    cameras = viewpoint_cameras(config.camera, outfit.body_model, poses[rows], outfit.betas, size)
    return [ReelFrame(row, (camera,)) for row, camera in zip(rows, cameras, strict=True)]

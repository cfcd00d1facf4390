"""Render: a trained subject, or an outfit of bundles, in any motion, seen by any cameras.

Reads:
    SUBJECT (register-template, bake-maps, train artifacts), or `.gwg` bundles; a pose file; for a capture's
    cameras its calibration and the list of its images.
Writes, into the output folder:
    frames and passes as `stages/shared/outfit/reel.py` says, one folder per camera for a capture's cameras;
    film.mp4 (or .webm), contact_sheet.png, result.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from stages.pipeline import BAKE_MAPS, DISTILL, REGISTER_TEMPLATE, TRAIN
from stages.render.config import RenderConfig
from stages.shared.artifacts import Workspace
from stages.shared.artifacts.canonical import readable_json
from stages.shared.artifacts.files import write_file
from stages.shared.body import Poses
from stages.shared.capture import Take, open_capture
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles, outfit_of_training
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.reel import ReelConfig, ReelFrame, check_passes, write_reel
from stages.shared.outfit.sources import (
    capture_frames,
    capture_take,
    parse_background,
    parse_betas,
    parse_frames,
    read_bundles,
)
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.pictures.folder import check_output, output_folder
from stages.shared.plan import Plan
from stages.shared.poses.read import load_poses
from stages.shared.report import SILENT, Report

MARK = "gw-render"
RESULT_NAME = "result.json"


@dataclass(frozen=True)
class RenderResult:
    """The folder, and what happened."""

    path: Path
    summary: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is decided before the first picture.

    Attributes:
        outfit, poses: what moves, and how. frames: rows and cameras. take: of the capture, when its cameras
            are used. digests: of the bundles by layer.
    """

    outfit: Outfit
    poses: Poses
    frames: list[ReelFrame]
    take: Take | None
    digests: dict[str, str]


def run(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
    report: Report = SILENT,
) -> RenderResult:
    """Render and write.

    Arguments:
        sources: one subject folder, or bundles.
        poses_path: None: the subject's own, or the capture's.
        cameras_path: a capture whose cameras look on; None for a camera path.

    Raises:
        UsageProblem: what cannot be meant. MissingInput, BadData: inputs. StorageFailure: disk full.
    """
    reel = _reel_config(config, cameras_path is not None)
    check_output(output, RESULT_NAME, MARK)
    report.step("reading")
    scene = open_scene(sources, poses_path, cameras_path, config)
    report.say(
        f"{' < '.join(scene.outfit.names)}: {scene.outfit.gaussians} Gaussians, {len(scene.frames)} frames"
    )
    report.step("rendering")
    with output_folder(output, RESULT_NAME, MARK) as folder:
        reel_summary = write_reel(folder, scene.outfit, scene.poses, scene.frames, reel, report)
        cameras = {camera.name: None for frame in scene.frames for camera in frame.cameras}
        summary = {
            "layers": list(scene.outfit.names),
            "gaussians": scene.outfit.gaussians,
            "bundles": scene.digests,
            "betas": [round(float(value), 6) for value in scene.outfit.betas],
            "swapped_texels": {change.garment: change.count for change in scene.outfit.swaps},
            "cameras": list(cameras),
            "take": scene.take.name if scene.take else None,
            **reel_summary.as_dict(),
        }
        shown = {
            "fps": scene.poses.fps,
            "frames": [frame.row for frame in scene.frames],
            "passes": list(reel.passes),
            "camera_folders": reel.camera_folders,
            "config": asdict(config),
        }
        content = {"format": MARK, "version": 1, **shown, **summary}
        write_file(folder / RESULT_NAME, readable_json(content))
    return RenderResult(output, summary)


def plan(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    output: Path,
    config: RenderConfig = RenderConfig(),
) -> Plan:
    """What `run` would read, write and cost."""
    _reel_config(config, cameras_path is not None)
    scene = open_scene(sources, poses_path, cameras_path, config)
    count = sum(len(frame.cameras) for frame in scene.frames)
    pixels = sum(camera.width * camera.height for frame in scene.frames for camera in frame.cameras)
    given = [*sources, *(path for path in (poses_path, cameras_path) if path is not None)]
    return Plan(
        inputs=[str(path) for path in given],
        outputs=[str(output / name) for name in ("frames", "contact_sheet.png", RESULT_NAME)],
        config={**asdict(config), "layers": list(scene.outfit.names)},
        seconds=3.0 + count * (0.05 + 3e-6 * scene.outfit.gaussians) + 5e-7 * pixels,
        memory_bytes=600_000_000 + 3000 * scene.outfit.gaussians + 200 * pixels // max(count, 1),
        disk_bytes=int(pixels * 0.4),
    )


def open_scene(
    sources: Sequence[Path], poses_path: Path | None, cameras_path: Path | None, config: RenderConfig
) -> Scene:
    """Read outfit, poses and cameras."""
    outfit, own_poses, digests = _open_outfit(sources, config)
    if config.layers:
        outfit = only(outfit, config.layers)
    take = None
    if cameras_path is not None:
        take = capture_take(open_capture(cameras_path, body=outfit.body_model), config.take or None)
    if poses_path is not None:
        poses = load_poses(poses_path, outfit.body_model, config.fps or None)
    elif take is not None:
        poses = take.poses
    elif own_poses is not None:
        poses = own_poses
    else:
        raise MissingInput("There are no poses.", "option --poses", "Give a motion with --poses FILE.")
    return Scene(outfit, poses, _frames(outfit, poses, take, config), take, digests)


def only(outfit: Outfit, names: tuple[str, ...]) -> Outfit:
    """The outfit with some of its layers. Raises UsageProblem for one it does not have."""
    unknown = [name for name in names if name not in outfit.names]
    if unknown:
        raise UsageProblem(
            f"There is no layer {unknown[0]!r}.",
            "option --layers",
            "Choose of: " + ", ".join(outfit.names) + ".",
        )
    return replace(outfit, layers=tuple(layer for layer in outfit.layers if layer.name in names))


def _open_outfit(
    sources: Sequence[Path], config: RenderConfig
) -> tuple[Outfit, Poses | None, dict[str, str]]:
    """The outfit, the subject's own poses if there is a subject, and the digests of bundles."""
    betas = parse_betas(config.betas)
    folders = [path for path in sources if path.is_dir()]
    if not folders:
        named = read_bundles(sources)
        digests = {bundle.layer: bundle.digest for _, bundle in named}
        return outfit_of_bundles(named, betas, config.swap), None, digests
    if len(sources) > 1:
        raise UsageProblem(
            "A subject is rendered as it is; bundles cannot be added to it.",
            ", ".join(str(path) for path in sources),
            "Give one subject, or bundles only (gw export-garment).",
        )
    workspace = Workspace(folders[0])
    registered = workspace.require(REGISTER_TEMPLATE)
    learned = workspace.require(DISTILL if config.distilled else TRAIN)
    outfit = outfit_of_training(registered, workspace.require(BAKE_MAPS), learned)
    poses = load_poses(registered.file("smpl_params.npz"), outfit.body_model)
    return outfit if betas is None else replace(outfit, betas=betas), poses, {}


def _frames(outfit: Outfit, poses: Poses, take: Take | None, config: RenderConfig) -> list[ReelFrame]:
    rows = parse_frames(config.frames, len(poses))
    if take is None:
        kind, size = config.camera or "static", (config.width, config.height)
        cameras = viewpoint_cameras(kind, outfit.body_model, poses[rows], outfit.betas, size)
        return [ReelFrame(row, (camera,)) for row, camera in zip(rows, cameras, strict=True)]
    frames = capture_frames(take, rows)
    if not config.camera:
        return frames
    camera = take.camera(config.camera)
    return [ReelFrame(row, (camera,)) for row in rows]


def _reel_config(config: RenderConfig, from_capture: bool) -> ReelConfig:
    check_passes(config.passes)
    passes = config.passes
    if from_capture and "labels" not in passes:
        passes = ("labels", *passes)  # `gw evaluate --frames` compares them with the capture's
    return ReelConfig(
        background=parse_background(config.background),
        passes=passes,
        penetration=PenetrationConfig() if config.penetration else None,
        film="film",
        camera_folders=from_capture,
    )

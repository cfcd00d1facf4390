"""Everything that is decided before the first picture: who, in which motion, seen by which cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from stages.pipeline import BAKE_MAPS, DISTILL, REGISTER_TEMPLATE, TRAIN
from stages.render.camera_path import path_cameras
from stages.render.config import RenderConfig
from stages.shared.artifacts import Workspace
from stages.shared.body import Poses, canonical_poses
from stages.shared.capture import Take, open_capture
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.outfit.grounding import grounded
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles, outfit_of_training
from stages.shared.outfit.reel import reel_key
from stages.shared.outfit.reel_config import ReelFrame
from stages.shared.outfit.sources import (
    capture_frames,
    capture_take,
    parse_betas,
    parse_frames,
    read_bundles,
)
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.poses.read import load_poses

CANONICAL = "canonical"  # in the place of a pose file: the pose of the maps
_STILL_FRAMES = 90  # of a camera that moves around it


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered.

    Attributes:
        outfit, poses: what moves, and how. frames: rows and cameras. take: of the capture, when its cameras
            are used. digests: of the bundles by layer, or of the subject's artifacts by stage.
    """

    outfit: Outfit
    poses: Poses
    frames: list[ReelFrame]
    take: Take | None
    digests: dict[str, str]

    def key(self, config: RenderConfig) -> str:
        """Names the content of the output: the same scene and configuration have the same key."""
        return reel_key(self.outfit, self.digests, self.poses, self.frames, config)


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
    if poses_path is not None and poses_path == Path(CANONICAL):
        poses = canonical_poses(1 if config.camera in ("", "static") else _STILL_FRAMES)
    elif poses_path is not None:
        poses = load_poses(poses_path, outfit.body_model, config.fps or None)
        if config.ground and take is None:
            poses = grounded(poses, outfit.body_model, outfit.betas)
    elif take is not None:
        poses = take.poses
    elif own_poses is not None:
        poses = own_poses
    else:
        raise MissingInput(
            "There are no poses.", "option --poses", "Give a motion with --poses FILE, or --poses canonical."
        )
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
    """The outfit, the subject's own poses if there is a subject, and what names the content of both."""
    betas = parse_betas(config.betas)
    folders = [path for path in sources if path.is_dir()]
    if not folders:
        named = read_bundles(sources)
        digests = {bundle.layer: bundle.digest for _, bundle in named}
        return outfit_of_bundles(named, betas, config.swap, config.push, config.restore), None, digests
    if len(sources) > 1:
        raise UsageProblem(
            "A subject is rendered as it is; bundles cannot be added to it.",
            ", ".join(str(path) for path in sources),
            "Give one subject, or bundles only (gw export-garment).",
        )
    workspace = Workspace(folders[0])
    specs = (REGISTER_TEMPLATE, BAKE_MAPS, DISTILL if config.distilled else TRAIN)
    registered, baked, learned = (workspace.require(spec) for spec in specs)
    outfit = outfit_of_training(registered, baked, learned)
    poses = load_poses(registered.file("smpl_params.npz"), outfit.body_model)
    digests = {part.stage: part.digest for part in (registered, baked, learned)}
    return outfit if betas is None else replace(outfit, betas=betas), poses, digests


def _frames(outfit: Outfit, poses: Poses, take: Take | None, config: RenderConfig) -> list[ReelFrame]:
    rows = parse_frames(config.frames, len(poses))
    size = (config.width, config.height)
    if config.camera.endswith(".json"):
        cameras = path_cameras(Path(config.camera), len(rows), size)
        return [ReelFrame(row, (camera,)) for row, camera in zip(rows, cameras, strict=True)]
    if take is None:
        kind = config.camera or "static"
        cameras = viewpoint_cameras(kind, outfit.body_model, poses[rows], outfit.betas, size, config.turns)
        return [ReelFrame(row, (camera,)) for row, camera in zip(rows, cameras, strict=True)]
    frames = capture_frames(take, rows)
    if not config.camera:
        return frames
    camera = take.camera(config.camera)
    return [ReelFrame(row, (camera,)) for row in rows]

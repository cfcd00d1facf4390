"""Everything that is decided before the first picture: the outfit, its motion, and the cameras."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.shared.artifacts import Workspace
from stages.shared.artifacts.canonical import KEY_LENGTH, canonical_json, digest
from stages.shared.body import BodyModel, Poses, canonical_poses
from stages.shared.capture import Capture, Take, open_capture
from stages.shared.capture.subject import open_subject_capture
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.input_files import CANONICAL
from stages.shared.outfit.outfit import Outfit, outfit_of_bundles
from stages.shared.outfit.retarget import fix_foot_height
from stages.shared.outfit.sources import capture_take, parse_betas, parse_frames, read_bundles
from stages.shared.outfit.trained_subject import TrainedSubject
from stages.shared.outfit.viewpoints import viewpoint_cameras
from stages.shared.poses.read import load_poses
from stages.shared.render_sequence.camera_path import path_cameras
from stages.shared.render_sequence.config import RenderConfig
from stages.shared.render_sequence.outputs import SequenceFrame
from stages.shared.report import SILENT, Report

_CODE_VERSION = 4  # raised when the same inputs give other files
_STILL_FRAMES = 90  # of the canonical pose, for a camera that moves around it


@dataclass(frozen=True, eq=False)
class RenderSequence:
    """What is rendered.

    Attributes:
        outfit: what is worn. poses: the motion. frames: rows of it and the cameras that see each.
        take: of the capture, when its cameras are used.
        digests: of the bundles by layer, or of the subject's artifacts by stage.
    """

    outfit: Outfit
    poses: Poses
    frames: list[SequenceFrame]
    take: Take | None
    digests: dict[str, str]

    def key(self, config: RenderConfig) -> str:
        """Names the content of the output: the same sequence and configuration have the same key."""
        seen = hashlib.sha256()
        for array in (self.poses.rotations, self.poses.translation, self.outfit.betas):
            seen.update(np.ascontiguousarray(array).tobytes())
        for frame in self.frames:
            for camera in frame.cameras:
                seen.update(f"{frame.row} {camera.name} {camera.width} {camera.height} ".encode())
                seen.update(camera.intrinsics.tobytes() + camera.camera_from_world.tobytes())
        parts = {"code": _CODE_VERSION, "config": config, "digests": self.digests, "seen": seen.hexdigest()}
        return digest(canonical_json(parts))[:KEY_LENGTH]


def open_sequence(
    sources: Sequence[Path],
    poses_path: Path | None,
    cameras_path: Path | None,
    config: RenderConfig,
    report: Report = SILENT,
) -> RenderSequence:
    """Read outfit, poses and cameras. Raises as `run` does."""
    outfit, subject_poses, digests = _open_outfit(sources, config)
    if config.layers:
        outfit = select_layers(outfit, config.layers)
    take = None
    if cameras_path is not None:
        capture = _shown_capture(cameras_path, sources[0], outfit.body_model, poses_path is None)
        take = capture_take(capture, config.take or None)
    if poses_path is not None and poses_path == Path(CANONICAL):
        poses = canonical_poses(1 if config.camera in ("", "static") else _STILL_FRAMES)
    elif poses_path is not None:
        poses = load_poses(poses_path, outfit.body_model, config.fps or None, report=report)
        if config.ground and take is None:
            poses = fix_foot_height(poses, outfit.body_model, outfit.betas)
    elif take is not None:
        poses = take.poses
    elif subject_poses is not None:
        poses = subject_poses
    else:
        raise MissingInput(
            "There are no poses.", "option --poses", "Give a motion with --poses FILE, or --poses canonical."
        )
    trained_poses = subject_poses is not None and (
        poses is subject_poses if take is None or poses_path is not None else take in capture.training_takes
    )
    outfit = outfit.driven(config.drive, trained_poses)
    return RenderSequence(outfit, poses, _frames(outfit, poses, take, config), take, digests)


def select_layers(outfit: Outfit, names: tuple[str, ...]) -> Outfit:
    """The outfit with some of its layers. Raises UsageProblem for one it does not have."""
    unknown = [name for name in names if name not in outfit.names]
    if unknown:
        raise UsageProblem(
            f"There is no layer {unknown[0]!r}.",
            "option --layers",
            "Choose of: " + ", ".join(outfit.names) + ".",
        )
    return replace(outfit, layers=tuple(layer for layer in outfit.layers if layer.name in names))


def capture_frames(take: Take, rows: Sequence[int] | None = None) -> list[SequenceFrame]:
    """The frames of a take that have images, each with the cameras that saw it.

    Raises:
        MissingInput: the take has no images among `rows`.
    """
    with_images = take.frames if rows is None else [frame for frame in take.frames if frame in set(rows)]
    frames = [
        SequenceFrame(frame, tuple(c for name, c in take.cameras.items() if take.has_image(name, frame)))
        for frame in with_images
    ]
    if not frames:
        raise MissingInput("The take has no images of these frames.", take.name, "Choose other frames.")
    return frames


def _open_outfit(
    sources: Sequence[Path], config: RenderConfig
) -> tuple[Outfit, Poses | None, dict[str, str]]:
    """The outfit, the poses of a subject (None for bundles), and the digests of what was read."""
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
    subject = TrainedSubject.open(folders[0], config.distilled)
    outfit, digests = subject.outfit(), subject.digests
    return outfit if betas is None else replace(outfit, betas=betas), subject.poses(), digests


def _shown_capture(path: Path, source: Path, body: BodyModel, needs_poses: bool) -> Capture:
    """The capture whose cameras are used; the subject's own has the poses that were fitted to it."""
    workspace = Workspace(source)
    own = workspace.settings().get("capture") if source.is_dir() else None
    if own and workspace.setting_path("capture").resolve() == path.resolve():
        return open_subject_capture(workspace, body)
    return open_capture(path, body=body, poses_needed=needs_poses)


def _frames(outfit: Outfit, poses: Poses, take: Take | None, config: RenderConfig) -> list[SequenceFrame]:
    """Rows of the motion, each with its cameras."""
    rows = parse_frames(config.frames, len(poses))
    size = (config.width, config.height)
    if take is not None and not config.camera:
        return capture_frames(take, rows)
    if config.camera.endswith(".json"):
        cameras = path_cameras(Path(config.camera), len(rows), size)
    elif take is not None:
        cameras = [take.camera(config.camera)] * len(rows)
    else:
        kind = config.camera or "static"
        cameras = viewpoint_cameras(kind, outfit.body_model, poses[rows], outfit.betas, size, config.turns)
    return [SequenceFrame(row, (camera,)) for row, camera in zip(rows, cameras, strict=True)]

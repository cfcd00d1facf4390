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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.artifacts.canonical import KEY_LENGTH, canonical_json, digest
from stages.shared.artifacts.files import make_folders, write_file, write_whole
from stages.shared.artifacts.pictures import encode_png
from stages.shared.avatar.compose import Composite
from stages.shared.body import Poses
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.export.cloud import cloud_of
from stages.shared.export.notes import NOTES_NAME, write_notes
from stages.shared.export.splats import write_splats
from stages.shared.outfit.hidden import LEAST_PICTURES, plan_hidden
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.picture import FINE, CutOffs, Shot, straight_alpha, take_picture, to_bytes
from stages.shared.outfit.playback import side_by_side, threads_restored
from stages.shared.outfit.player import Player
from stages.shared.pictures.background import WHITE, Background
from stages.shared.pictures.parts import RECORDS, Share
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.pictures.video import VideoWriter, chosen_suffix
from stages.shared.report import Report

PASSES = ("labels", "depth", "layers")
_CODE_VERSION = 1  # raised when the same inputs give other files
_SHEET_PICTURES, _SHEET_COLUMNS, _SHEET_SIDE = 12, 6, 320


@dataclass(frozen=True, eq=False)
class ReelFrame:
    """One moment: the row of the pose file, and the cameras that see it."""

    row: int
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class ReelConfig:
    """What is written.

    Attributes:
        background: behind film and contact sheet; the frames are transparent.
        passes: of `PASSES`.
        penetration: tolerances of the penetration pass, None to leave it out.
        film: name of the video without its suffix. video: of `VIDEOS`.
        camera_folders: one folder per camera, as a capture has them.
        exports: splat formats to write every frame's Gaussians in.
        pictures: whether there are pictures at all, or exports only.
        cull: leave out body Gaussians that nobody can see (`stages/shared/outfit/hidden.py`) in a film long
            enough for that to pay; never where the body alone is shown or exported.
        cutoffs: of the splatting.
    """

    background: Background = WHITE
    passes: tuple[str, ...] = ()
    penetration: PenetrationConfig | None = None
    film: str = "film"
    video: str = "auto"
    camera_folders: bool = False
    exports: tuple[str, ...] = ()
    pictures: bool = True
    cull: bool = True
    cutoffs: CutOffs = FINE


@dataclass
class ReelSummary:
    """Counts and times of a reel.

    `seconds` are those of every frame, by part; `wall` what posing and rendering took when frames were made
    side by side (so many frames at a time, each in so many seconds).
    """

    pictures: int = 0
    wall: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    penetrated: dict[str, int] = field(default_factory=dict)
    video: str | None = None

    def add(self, other: ReelSummary) -> None:
        """Count the pictures of another one as well."""
        self.pictures += other.pictures
        self.wall += other.wall
        for mine, theirs in ((self.seconds, other.seconds), (self.penetrated, other.penetrated)):
            for name, number in theirs.items():
                mine[name] = mine.get(name, 0) + number  # type: ignore[assignment]

    def clock(self, name: str, started: float) -> None:
        """Add the time since `started` (perf_counter) to a part of the work."""
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    @property
    def rendering(self) -> float:
        """Seconds of posing and of pictures, without files."""
        return self.seconds.get("pose", 0.0) + self.seconds.get("render", 0.0)

    def as_dict(self) -> dict[str, Any]:
        """For result.json; penetrated pixels are totals over all pictures."""
        return {
            "pictures": self.pictures,
            "penetrated_pixels": self.penetrated,
            "video": self.video,
            "frames_per_second": round(self.pictures / self.wall, 2) if self.wall else None,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
        }


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
        summary.video = _write_film(folder, poses.fps, frames, config)
        _write_sheet(folder, frames, config)
    summary.clock("film", started)
    return summary


def check_passes(passes: tuple[str, ...]) -> None:
    """Raise UsageProblem for a pass that does not exist."""
    unknown = [name for name in passes if name not in PASSES]
    if unknown:
        raise UsageProblem(
            f"There is no pass called {unknown[0]!r}.",
            "option --passes",
            "Choose of: " + ", ".join(PASSES) + ".",
        )


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
        _write_exports(folder, composite, frame.row, config.exports)
        counted.clock("export", started)
    for camera in frame.cameras if config.pictures else ():
        started = time.perf_counter()
        layers = "layers" in config.passes
        shot = take_picture(composite, camera, config.penetration, layers, cutoffs=config.cutoffs)
        counted.clock("render", started)
        counted.add(ReelSummary(pictures=1, penetrated=shot.counts))
        started = time.perf_counter()
        _write_shot(folder, shot, _name(frame.row, camera, config), config.passes)
        counted.clock("write", started)
    return counted


def _write_shot(folder: Path, shot: Shot, name: str, passes: tuple[str, ...]) -> None:
    """All files of one picture."""
    files = {f"frames/{name}": encode_png(shot.straight())}
    if "labels" in passes:
        files[f"labels/{name}"] = encode_png(shot.labels)
    if "depth" in passes:
        files[f"depth/{name}"] = _depth_png(shot.depth)
    for layer, values in shot.layers.items():
        picture = to_bytes(straight_alpha(values[..., :3], values[..., 3]))
        files[f"layers/{layer}/{name}"] = encode_png(picture)
    for path, data in files.items():
        make_folders((folder / path).parent)
        (folder / path).unlink(missing_ok=True)  # of a frame that a kill left unfinished
        write_file(folder / path, data)


def _write_exports(folder: Path, composite: Composite, row: int, kinds: tuple[str, ...]) -> None:
    cloud = cloud_of(composite)
    for kind in kinds:
        write_splats(folder / kind / f"frame{row:06d}.{kind}", cloud, composite.layers)


def _write_film(folder: Path, fps: float, frames: Sequence[ReelFrame], config: ReelConfig) -> str | None:
    """The first camera's film; its name, or None where there is none."""
    suffix = chosen_suffix(config.video, config.background.transparent)
    if not suffix or len(frames) < 2:
        return None
    clear = config.background.transparent
    name = config.film + suffix
    with VideoWriter(folder / name, fps, clear) as film:
        for picture in _first_pictures(folder, frames, config):
            film.add(picture if clear else config.background.under(picture))
    return name


def _write_sheet(folder: Path, frames: Sequence[ReelFrame], config: ReelConfig) -> None:
    few = [frames[index] for index in chosen(len(frames), _SHEET_PICTURES)]
    pictures = [
        shrunk(config.background.under(picture), _SHEET_SIDE)
        for picture in _first_pictures(folder, few, config)
    ]
    page = contact_sheet(pictures, _SHEET_COLUMNS, [f"frame {frame.row}" for frame in few])
    (folder / "contact_sheet.png").unlink(missing_ok=True)
    write_file(folder / "contact_sheet.png", encode_png(page))


def _first_pictures(
    folder: Path, frames: Sequence[ReelFrame], config: ReelConfig
) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 4) u8 RGBA of the first camera of every frame, one after the other."""
    for frame in frames:
        path = folder / "frames" / _name(frame.row, frame.cameras[0], config)
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert picture is not None, path
        yield np.asarray(picture[..., [2, 1, 0, 3]], np.uint8)


def _name(row: int, camera: Camera, config: ReelConfig) -> str:
    return f"{camera.name}/{row:06d}.png" if config.camera_folders else f"{row:06d}.png"


def _record(folder: Path, row: int) -> Path:
    return folder / RECORDS / f"{row:06d}.json"


def _depth_png(depth: NDArray[np.float32]) -> bytes:
    """16-bit PNG of millimetres, at most 65.535 m."""
    millimetres = np.clip(np.rint(depth * 1000), 0, 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", millimetres)[1])

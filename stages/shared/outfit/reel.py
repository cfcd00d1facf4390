"""An outfit through a motion: every frame by every camera, into files, one frame in memory at a time.

Writes, below a folder:
    frames/[CAMERA/]RRRRRR.png    (H,W,4) u8 sRGB with straight alpha; RRRRRR is the row of the pose file
    labels/[CAMERA/]RRRRRR.png    (H,W) u8 label ids, 255 none               (pass "labels")
    depth/[CAMERA/]RRRRRR.png     (H,W) u16 millimetres, 0 none              (pass "depth")
    layers/LAYER/[CAMERA/]RRRRRR.png   (H,W,4) u8, each layer alone          (pass "layers")
    NAME.mp4 or NAME.webm         the first camera's film; contact_sheet.png
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.files import make_folders, write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.body import Poses
from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.picture import Shot, straight_alpha, take_picture, to_bytes
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.pictures.video import VideoWriter, video_suffix
from stages.shared.report import Report

PASSES = ("labels", "depth", "layers")
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
        background: sRGB 0..1 behind film and contact sheet; the frames are transparent.
        passes: of `PASSES`.
        penetration: tolerances of the penetration pass, None to leave it out.
        film: name of the video without its suffix; "" for none.
        camera_folders: one folder per camera, as a capture has them.
    """

    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    passes: tuple[str, ...] = ()
    penetration: PenetrationConfig | None = None
    film: str = "film"
    camera_folders: bool = False


@dataclass
class ReelSummary:
    """Counts and times of a reel."""

    pictures: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    penetrated: dict[str, int] = field(default_factory=dict)
    video: str | None = None

    def add(self, shot: Shot) -> None:
        """Count a picture."""
        self.pictures += 1
        for pair, number in shot.counts.items():
            self.penetrated[pair] = self.penetrated.get(pair, 0) + number

    def as_dict(self) -> dict[str, Any]:
        """For result.json; penetrated pixels are totals over all pictures."""
        rendering = self.seconds.get("pose", 0.0) + self.seconds.get("render", 0.0)
        return {
            "pictures": self.pictures,
            "penetrated_pixels": self.penetrated,
            "video": self.video,
            "frames_per_second": round(self.pictures / rendering, 2) if rendering else None,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
        }


def write_reel(
    folder: Path,
    outfit: Outfit,
    poses: Poses,
    frames: Sequence[ReelFrame],
    config: ReelConfig,
    report: Report,
) -> ReelSummary:
    """Render and write everything; memory does not grow with the number of frames.

    Arguments:
        folder: an empty folder, renamed into place by the caller.
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
    summary, sheet = ReelSummary(), []
    sheet_rows = set(chosen(len(frames), _SHEET_PICTURES))
    with contextlib.ExitStack() as stack:
        film = None
        if config.film and len(frames) > 1:
            summary.video = config.film + video_suffix()
            film = stack.enter_context(VideoWriter(folder / summary.video, poses.fps))
        for index, frame in enumerate(frames):
            with _clock(summary, "pose"):
                composite = outfit.composite(poses, frame.row)
            for order, camera in enumerate(frame.cameras):
                with _clock(summary, "render"):
                    shot = take_picture(composite, camera, config.penetration, "layers" in config.passes)
                summary.add(shot)
                with _clock(summary, "write"):
                    _write_shot(folder, shot, frame.row, camera.name, config)
                    if order == 0:
                        picture = shot.on(config.background)
                        if film is not None:
                            film.add(picture)
                        if index in sheet_rows:
                            sheet.append((picture, f"frame {frame.row}"))
            report.progress(index + 1, len(frames))
    pictures = [shrunk(picture, _SHEET_SIDE) for picture, _ in sheet]
    page = contact_sheet(pictures, _SHEET_COLUMNS, [text for _, text in sheet])
    write_file(folder / "contact_sheet.png", encode_png(page))
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


def _write_shot(folder: Path, shot: Shot, row: int, camera: str, config: ReelConfig) -> None:
    """All files of one picture."""
    name = f"{camera}/{row:06d}.png" if config.camera_folders else f"{row:06d}.png"
    files = {f"frames/{name}": encode_png(shot.straight())}
    if "labels" in config.passes:
        files[f"labels/{name}"] = encode_png(shot.labels)
    if "depth" in config.passes:
        files[f"depth/{name}"] = _depth_png(shot.depth)
    for layer, values in shot.layers.items():
        picture = to_bytes(straight_alpha(values[..., :3], values[..., 3]))
        files[f"layers/{layer}/{name}"] = encode_png(picture)
    for path, data in files.items():
        make_folders((folder / path).parent)
        write_file(folder / path, data)


def _depth_png(depth: NDArray[np.float32]) -> bytes:
    """16-bit PNG of millimetres, at most 65.535 m."""
    millimetres = np.clip(np.rint(depth * 1000), 0, 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", millimetres)[1])


@contextlib.contextmanager
def _clock(summary: ReelSummary, name: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    summary.seconds[name] = summary.seconds.get(name, 0.0) + time.perf_counter() - started

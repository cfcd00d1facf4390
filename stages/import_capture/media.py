"""Which pictures and videos a source has, and which calibrated camera each belongs to."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.import_capture import pictures, videos
from stages.shared.errors import MissingInput

Doubles = NDArray[np.float64]
_MEDIA_FOLDERS = ("", "videos", "video", "images", "rgb", "pictures")
_NOT_CAMERAS = {"masks", "mask", "labels", "background", "backgrounds", "sparse", "calibration"}
DEFAULT_FPS = 30.0


@dataclass(frozen=True, eq=False)
class Recording:
    """What one camera recorded.

    Attributes:
        name: of the file or folder.
        video: the file, or None.
        files: pictures in their order, empty for a video.
        times: (N,) seconds since its first frame; NaN for pictures, whose rate nobody states.
    """

    name: str
    video: Path | None
    files: tuple[Path, ...]
    times: Doubles

    @property
    def count(self) -> int:
        """How many frames there are."""
        return len(self.times)

    @property
    def path(self) -> Path:
        """The video, or the folder of the pictures."""
        return self.video or self.files[0].parent


def find_recordings(source: Path) -> list[Recording]:
    """The recordings in a folder: videos, a folder of pictures a camera, or a single picture a camera.

    Raises:
        MissingInput: no such folder, or nothing in it.
    """
    if not source.is_dir():
        raise MissingInput("There is no such folder.", str(source), "Give a folder of videos or pictures.")
    for name in _MEDIA_FOLDERS:
        folder = source / name if name else source
        if folder.is_dir():
            recordings = _videos(folder) or _picture_folders(folder) or _single_pictures(folder)
            if recordings:
                return recordings
    raise MissingInput(
        "There are no videos and no pictures here.",
        f"{source}; looked for videos, <camera>/*.png or .jpg, and one picture a camera",
        "Give the folder that holds one video, or one folder of pictures, a camera.",
    )


def by_camera(recordings: list[Recording], cameras: Iterable[str]) -> tuple[dict[str, Recording], list[str]]:
    """Recordings by the name of their calibrated camera, and notes on what was assumed or left out.

    A recording belongs to the camera whose name it has, or whose name is one of the parts of its name. Where
    no names agree and the numbers do, both are taken in order.

    Raises:
        MissingInput: no recording can be assigned.
    """
    names = list(cameras)
    result: dict[str, Recording] = {}
    left = []
    for recording in recordings:
        camera = _camera_of(recording.name, names)
        if camera is None or camera in result:
            left.append(recording.name)
        else:
            result[camera] = recording
    notes = []
    if not result and len(names) == len(recordings):
        notes.append("names of recordings and cameras differ; both are taken in alphabetical order")
        result = dict(zip(sorted(names, key=_in_order), recordings, strict=True))
        left = []
    if not result:
        raise MissingInput(
            "No recording has the name of a calibrated camera.",
            f"recordings {', '.join(one.name for one in recordings[:6])}; cameras {', '.join(names[:6])}",
            "Name the videos or folders as the calibration names the cameras.",
        )
    if left:
        notes.append(f"recordings without a calibrated camera are left out: {', '.join(left)}")
    missing = [name for name in names if name not in result]
    if missing:
        notes.append(f"cameras without a recording are left out: {', '.join(missing)}")
    return {name: result[name] for name in names if name in result}, notes


def frame_table(
    recordings: Mapping[str, Recording],
    fps: float | None,
    offsets: Mapping[str, float],
    frames: tuple[int, int | None, int],
) -> tuple[float, dict[str, list[int | None]]]:
    """Frames per second, and for every camera the frame of its recording in each row of the take.

    Rows are equally spaced in time from the moment at which all cameras record. The nearest frame is taken; a
    row that no frame is near to (more than a row away) has None.

    Arguments:
        offsets: seconds by which a recording began later.
        frames: start, stop and step of the rows that are kept.
    """
    step = slice(*frames)
    moving = {name: one for name, one in recordings.items() if np.isfinite(one.times).all() and one.count > 1}
    if not moving:
        count = max(one.count for one in recordings.values())
        rows = range(count)[step]
        table = {name: [row if row < one.count else None for row in rows] for name, one in recordings.items()}
        return (fps or DEFAULT_FPS) / frames[2], table
    rates = [1 / float(np.median(np.diff(one.times))) for one in moving.values()]
    rate = fps or round(float(np.median(rates)), 3)
    begins = {name: float(offsets.get(name, 0.0)) for name in recordings}
    first = max(begins.values())
    last = min(begins[name] + float(one.times[-1]) for name, one in moving.items())
    times = first + np.arange(int(np.floor((last - first) * rate + 1.001))) / rate
    result: dict[str, list[int | None]] = {}
    for name, one in recordings.items():
        local = times[step] - begins[name]
        own = one.times if name in moving else np.arange(one.count) / rate
        nearest = np.abs(own[None] - local[:, None]).argmin(axis=1)
        away = np.abs(own[nearest] - local)
        result[name] = [
            int(frame) if gap <= 1 / rate else None for frame, gap in zip(nearest, away, strict=True)
        ]
    return rate / frames[2], result


def _videos(folder: Path) -> list[Recording]:
    files = _files(folder, videos.SUFFIXES)
    named = [(path.stem, path) for path in files]
    if not named:
        for child in _camera_folders(folder):
            inside = _files(child, videos.SUFFIXES)
            if len(inside) == 1:
                named.append((child.name, inside[0]))
    return [Recording(name, path, (), videos.frame_times(path)) for name, path in named]


def _picture_folders(folder: Path) -> list[Recording]:
    recordings = []
    for child in _camera_folders(folder):
        files = _files(child, pictures.SUFFIXES)
        if files:
            recordings.append(Recording(child.name, None, tuple(files), np.full(len(files), np.nan)))
    return recordings


def _single_pictures(folder: Path) -> list[Recording]:
    files = _files(folder, pictures.SUFFIXES)
    return [Recording(path.stem, None, (path,), np.full(1, np.nan)) for path in files]


def _camera_folders(folder: Path) -> list[Path]:
    children = [path for path in folder.iterdir() if path.is_dir() and path.name.lower() not in _NOT_CAMERAS]
    return sorted(children, key=lambda path: _in_order(path.name))


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    files = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith(".")
    ]
    return sorted(files, key=lambda path: _in_order(path.name))


def _in_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts cam2 before cam10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _camera_of(name: str, cameras: list[str]) -> str | None:
    lower = {camera.lower(): camera for camera in cameras}
    if name.lower() in lower:
        return lower[name.lower()]
    parts = re.split(r"[^A-Za-z0-9]+", name.lower())
    matching = [camera for key, camera in lower.items() if key in parts]
    return matching[0] if len(matching) == 1 else None

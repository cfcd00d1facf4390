"""Frames of a video at given times; rotation flags are applied, the frame rate may vary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData

_Image = NDArray[np.uint8]
Doubles = NDArray[np.float64]

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv")
_HIGH_DYNAMIC_RANGE = (16, 18)  # transfer functions PQ and HLG


def frame_times(path: Path) -> Doubles:
    """(N,) seconds since the first frame, ascending; no picture is decoded.

    Raises:
        BadData: no video, or one without times.
    """
    with _opened(path) as container:
        stream = container.streams.video[0]
        base = float(stream.time_base)
        times = [packet.pts * base for packet in container.demux(stream) if packet.pts is not None]
    if not times:
        raise _unreadable(path, "no frame has a time")
    ordered = np.unique(np.array(times, np.float64))
    return np.asarray(ordered - ordered[0], np.float64)


def read_frames(path: Path, wanted: Mapping[int, list[int]]) -> Iterator[tuple[int, _Image]]:
    """Frames of a video as RGB (H, W, 3) u8, upright, in the order of the video.

    Arguments:
        wanted: number of a frame in order of time to the rows of the take that show it.
    """
    if not wanted:
        return
    last = max(wanted)
    with _opened(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        try:
            for number, frame in enumerate(container.decode(stream)):
                if number in wanted:
                    picture = upright(frame.to_ndarray(format="rgb24"), int(frame.rotation))
                    for row in wanted[number]:
                        yield row, picture
                if number >= last:
                    return
        except Exception as error:
            if "av." in type(error).__module__:
                raise _unreadable(path, str(error)) from error
            raise
    raise _unreadable(path, f"it ends before frame {last}")


def upright(picture: _Image, degrees: int) -> _Image:
    """The picture turned counterclockwise by a multiple of 90 degrees, as its rotation flag says."""
    return np.ascontiguousarray(np.rot90(picture, round(degrees / 90) % 4))


def high_dynamic_range(path: Path) -> bool:
    """Whether the first frame says that its brightness is of an HDR curve."""
    with _opened(path) as container:
        for frame in container.decode(container.streams.video[0]):
            return int(getattr(frame, "color_trc", 0) or 0) in _HIGH_DYNAMIC_RANGE
    return False


def _opened(path: Path) -> Any:
    import av

    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise _unreadable(path, str(error)) from error
    if not container.streams.video:
        container.close()
        raise _unreadable(path, "it has no video stream")
    return container


def _unreadable(path: Path, reason: str) -> BadData:
    return BadData(f"The video cannot be read: {reason}.", str(path), "Convert it to H.264 in MP4.")

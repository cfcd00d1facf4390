"""How long a large capture takes to open: every file of every camera is listed, no picture is read."""

from __future__ import annotations

import os
import resource
import shutil
import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from gw_cli.console import Console
from gw_cli.options import Json
from stages.shared.body.poses import Poses
from stages.shared.capture import Camera, native_writer, open_capture
from tests.benchmarks.command import application

_SIDE = 8  # pixels of the pictures
_KINDS = (("rgb", "jpg"), ("masks", "png"), ("labels", "png"))


def write_capture(root: Path, cameras: int, frames: int) -> None:
    """A native capture with tiny pictures; those of one camera and kind are links to one file."""
    calibrated = [
        Camera(f"cam{n:03d}", _SIDE, _SIDE, np.array([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]]), np.eye(4))
        for n in range(cameras)
    ]
    rest = Poses(
        np.zeros((frames, 55, 3), np.float32),
        np.zeros((frames, 3), np.float32),
        np.zeros(10, np.float32),
        np.zeros((frames, 10), np.float32),
    )
    grey = np.full((_SIDE, _SIDE), 200, np.uint8)
    with native_writer(root, calibrated) as writer:
        take = writer.take("walk", "train", rest)
        for camera in calibrated:
            take.view(camera.name, 0, np.repeat(grey[..., None], 3, axis=2), grey, grey // 200)
    for camera in calibrated:
        for kind, suffix in _KINDS:
            folder = root / "takes" / "walk" / kind / camera.name
            for frame in range(1, frames):
                os.link(folder / f"000000.{suffix}", folder / f"{frame:06d}.{suffix}")


def large_capture(
    cameras: Annotated[int, typer.Option(min=1, help="Cameras of the capture.")] = 160,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each camera.")] = 1000,
    rounds: Annotated[int, typer.Option(min=1, help="How often it is opened.")] = 3,
    as_json: Json = False,
) -> None:
    """Write a capture with tiny pictures, open it, and print the seconds of each round."""
    console = Console(as_json)
    root = Path(tempfile.mkdtemp())
    try:
        write_capture(root / "capture", cameras, frames)
        seconds = []
        for _ in range(rounds):
            started = time.perf_counter()
            take = open_capture(root / "capture").takes[0]
            seconds.append(round(time.perf_counter() - started, 3))
            assert len(take.frames) == frames and len(take.views) == cameras * frames
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    finally:
        shutil.rmtree(root)
    console.result({"cameras": cameras, "frames": frames, "seconds": seconds, "peak_mib": peak})


app = application(large_capture)

if __name__ == "__main__":
    app()

"""The pictures of the README, from a finished demo: both films as an animated WebP, and the sheet of outfits.

python -m tests.benchmarks.readme_images DEMO -o docs/images
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import av
import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from gw_cli.console import Console
from tests.benchmarks.command import application

HEIGHT = 400  # px of the film
EVERY = 2  # frames of the film that are kept, of the 30 a second of the demo
QUALITY = 70  # of WebP and JPEG


def film_frames(path: Path, height: int, every: int) -> Iterator[NDArray[np.uint8]]:
    """Every so many frames of a film, (H, W, 3) u8 sRGB, at a height in pixels."""
    with av.open(str(path)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            if number % every == 0:
                image = frame.to_ndarray(format="rgb24")
                width = round(image.shape[1] * height / image.shape[0])
                yield np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def write_animation(path: Path, frames: list[NDArray[np.uint8]], milliseconds: int) -> None:
    """An endless animated WebP of frames (H, W, 3) u8 sRGB."""
    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    animation.durations = [milliseconds] * len(frames)
    if not cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise OSError(f"OpenCV cannot write {path}")


def main(
    demo: Annotated[Path, typer.Argument(metavar="DEMO", help="Folder of a finished `gw demo`.")],
    output: Annotated[Path, typer.Option("-o", help="Folder of the pictures.")] = Path("docs/images"),
) -> None:
    """Write tryon.webp and demo_outfits.jpg."""
    console = Console(False)
    frames = [
        frame
        for part in ("tryon", "tryon_changed")
        for frame in film_frames(demo / part / "tryon.mp4", HEIGHT, EVERY)
    ]
    write_animation(output / "tryon.webp", frames, round(1000 * EVERY / 30))
    sheet = cv2.imread(str(demo / "outfits" / "outfits.png"))
    if sheet is None:
        raise OSError(f"{demo} has no sheet of outfits")
    scale = min(1.0, 1600 / sheet.shape[1])
    smaller = cv2.resize(sheet, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(output / "demo_outfits.jpg"), smaller, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    console.result({"frames": len(frames), "bytes": (output / "tryon.webp").stat().st_size})


app = application(main)

if __name__ == "__main__":
    app()

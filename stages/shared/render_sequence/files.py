"""The files of a render sequence: those of one moment, and video and contact sheet made from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.files import make_folders, write_file
from stages.shared.artifacts.pictures import encode_png
from stages.shared.capture.camera import Camera
from stages.shared.export.cloud import cloud_of, turned_over
from stages.shared.export.splats import up_of, write_splats
from stages.shared.outfit.render_image import RenderedImage, straight_alpha, to_bytes
from stages.shared.pictures.sheet import chosen, contact_sheet, shrunk
from stages.shared.pictures.video import VideoWriter, chosen_suffix
from stages.shared.render_sequence.outputs import SequenceFrame, SequenceOutputs
from stages.shared.splat.gaussians import Gaussians

_SHEET_PICTURES, _SHEET_COLUMNS, _SHEET_SIDE = 12, 6, 320


def write_passes(folder: Path, shot: RenderedImage, name: str, passes: tuple[str, ...]) -> None:
    """All files of one picture; name: `picture_name`."""
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


def write_exports(
    folder: Path, composite: Gaussians, row: int, kinds: tuple[str, ...], up: str = "auto"
) -> None:
    """One moment's Gaussians in every splat format of `kinds`; `up` as `up_of` takes it."""
    cloud = cloud_of(composite)
    for kind in kinds:
        upright = cloud if up_of(kind, up) == "y" else turned_over(cloud)
        write_splats(folder / kind / f"frame{row:06d}.{kind}", upright, composite.layers)


def write_video(
    folder: Path, fps: float, frames: Sequence[SequenceFrame], outputs: SequenceOutputs
) -> str | None:
    """The first camera's video; its name, or None where none is written."""
    transparent = outputs.background.transparent
    suffix = chosen_suffix(outputs.video, transparent)
    if not suffix or len(frames) < 2:
        return None
    name = outputs.video_name + suffix
    with VideoWriter(folder / name, fps, transparent) as video:
        for picture in _first_pictures(folder, frames, outputs):
            video.add(picture if transparent else outputs.background.under(picture))
    return name


def write_sheet(folder: Path, frames: Sequence[SequenceFrame], outputs: SequenceOutputs) -> None:
    """The contact sheet: up to twelve pictures of the first camera."""
    few = [frames[index] for index in chosen(len(frames), _SHEET_PICTURES)]
    pictures = [
        shrunk(outputs.background.under(picture), _SHEET_SIDE)
        for picture in _first_pictures(folder, few, outputs)
    ]
    page = contact_sheet(pictures, _SHEET_COLUMNS, [f"frame {frame.row}" for frame in few])
    (folder / "contact_sheet.png").unlink(missing_ok=True)
    write_file(folder / "contact_sheet.png", encode_png(page))


def _first_pictures(
    folder: Path, frames: Sequence[SequenceFrame], outputs: SequenceOutputs
) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 4) u8 RGBA of the first camera of every frame, in order."""
    for frame in frames:
        path = folder / "frames" / picture_name(frame.row, frame.cameras[0], outputs)
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert picture is not None, path
        yield np.asarray(picture[..., [2, 1, 0, 3]], np.uint8)


def picture_name(row: int, camera: Camera, outputs: SequenceOutputs) -> str:
    """Path of a picture below the folder of its kind."""
    return f"{camera.name}/{row:06d}.png" if outputs.camera_folders else f"{row:06d}.png"


def _depth_png(depth: NDArray[np.float32]) -> bytes:
    """16-bit PNG of millimetres, at most 65.535 m."""
    millimetres = np.clip(np.rint(depth * 1000), 0, 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", millimetres)[1])

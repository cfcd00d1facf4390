"""Writer for the native layout: a capture that is whole or absent."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.artifacts.files import make_folders, whole_folder, write_file
from stages.shared.body.poses import Poses
from stages.shared.capture.camera import Camera
from stages.shared.capture.native import FORMAT_MARK, FORMAT_VERSION, NAME
from stages.shared.capture.take import Split

JPEG_QUALITY = 95
_Image = NDArray[np.uint8]


class TakeWriter:
    """Writes the frames of one take. Safe to call from several threads for different views."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def view(
        self,
        camera: str,
        frame: int,
        image: _Image,
        mask: _Image,
        labels: _Image | None = None,
        jpeg: bool = True,
    ) -> None:
        """One view: image (H, W, 3) u8 sRGB, mask (H, W) u8 0..255, labels (H, W) u8 ids (255 none)."""
        self.picture(camera, frame, image, jpeg)
        self.mask(camera, frame, mask)
        if labels is not None:
            self._write("labels", camera, f"{frame:06d}.png", labels, [])

    def picture(self, camera: str, frame: int, image: _Image, jpeg: bool = True) -> None:
        """One picture (H, W, 3) u8 sRGB by itself; its mask follows."""
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if jpeg else []
        name = f"{frame:06d}" + (".jpg" if jpeg else ".png")
        self._write("rgb", camera, name, np.ascontiguousarray(image[..., ::-1]), options)

    def mask(self, camera: str, frame: int, mask: _Image) -> None:
        """One mask (H, W) u8 0..255 by itself."""
        self._write("masks", camera, f"{frame:06d}.png", mask, [])

    def scan(self, data: bytes) -> None:
        """The content of a PLY of the dressed person (vertices, faces, colours, `label` per vertex)."""
        write_file(self.folder / "scan.ply", data)

    def extra(self, name: str, data: bytes) -> Path:
        """Any other file of the take, e.g. ground truth to judge by; readers ignore it."""
        path = self.folder / name
        make_folders(path.parent)
        write_file(path, data)
        return path

    def _write(self, group: str, camera: str, name: str, image: _Image, options: list[int]) -> None:
        if image.dtype != np.uint8:
            raise ValueError(f"{group}/{camera}/{name}: {image.dtype}, not uint8")
        folder = self.folder / group / camera
        make_folders(folder)
        _, data = cv2.imencode(Path(name).suffix, image, options)
        write_file(folder / name, data.tobytes())


class NativeWriter:
    """Writes a capture folder; use through `native_writer`."""

    def __init__(self, folder: Path, cameras: Iterable[Camera], heldout: Iterable[str] = ()) -> None:
        self.folder = folder
        self.takes: list[dict[str, Any]] = []
        self.notes: dict[str, Any] = {}
        write_file(folder / "cameras.json", cameras_json(cameras, heldout))

    def replace_cameras(self, cameras: Iterable[Camera], heldout: Iterable[str] = ()) -> None:
        """Other cameras than at the beginning: their world may be known only when the pictures are read."""
        (self.folder / "cameras.json").unlink()
        write_file(self.folder / "cameras.json", cameras_json(cameras, heldout))

    def take(self, name: str, split: Split, poses: Poses | None, scan_frame: int = 0) -> TakeWriter:
        """A new take with poses for all its frames (row = frame number), or without any."""
        if not NAME.fullmatch(name):
            raise ValueError(f"unusable take name {name!r}")
        folder = self.folder / "takes" / name
        make_folders(folder)
        entry = {"name": name, "split": split, "scan_frame": scan_frame}
        if poses is not None:
            write_file(folder / "smpl_params.npz", poses.to_npz_bytes())
            entry["fps"] = poses.fps
        self.takes.append(entry)
        return TakeWriter(folder)

    def body_model(self, data: bytes, suffix: str = ".npz") -> None:
        """The body model that the poses are for: content of a `.npz` (SMPL-X layout) or `.safetensors`."""
        write_file(self.folder / f"body_model{suffix}", data)

    def extra(self, name: str, data: bytes) -> Path:
        """Any other file of the capture; readers ignore it."""
        path = self.folder / name
        make_folders(path.parent)
        write_file(path, data)
        return path

    def finish(self) -> None:
        """Write `capture.json`."""
        content = {"format": FORMAT_MARK, "version": FORMAT_VERSION, "takes": self.takes, "about": self.notes}
        write_file(self.folder / "capture.json", (json.dumps(content, indent=1) + "\n").encode())


@contextlib.contextmanager
def native_writer(
    path: Path, cameras: Iterable[Camera], heldout: Iterable[str] = ()
) -> Iterator[NativeWriter]:
    """A capture at `path`, whole or absent: what stood there is replaced at the end.

    Arguments:
        path: the capture's folder.
        cameras: of all takes, in an order that is kept.
        heldout: names of the cameras that are for judging only.

    Raises:
        StorageFailure: disk full, no permission.
    """
    with whole_folder(path) as folder:
        writer = NativeWriter(folder, cameras, heldout)
        yield writer
        writer.finish()


def cameras_json(cameras: Iterable[Camera], heldout: Iterable[str] = ()) -> bytes:
    """The content of a `cameras.json`."""
    held = set(heldout)
    entries = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "intrinsics": camera.intrinsics.tolist(),
            "camera_from_world": camera.camera_from_world.tolist(),
            "held_out": camera.name in held,
        }
        for camera in cameras
    ]
    return (json.dumps({"cameras": entries}, indent=1) + "\n").encode()

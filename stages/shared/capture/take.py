"""A capture in memory: takes of one person, calibrated cameras, poses. Pixels are read when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from stages.shared.body.poses import Poses
from stages.shared.capture.camera import Box, Camera
from stages.shared.capture.images import check_size, read_image, read_mask
from stages.shared.capture.labels import read_labels
from stages.shared.capture.pickled_scan import read_scan
from stages.shared.capture.view_files import TakeViews, ViewFiles
from stages.shared.errors import BadData, MissingInput, UsageProblem
from stages.shared.meshes.load import load_mesh
from stages.shared.meshes.mesh import Mesh

Split = Literal["train", "test"]
GROUPS: Final = ("cameras", "poses", "images", "masks", "labels", "scan", "body")
MASK_THRESHOLD: Final = 127  # coverage 0..255 above which a pixel shows the person
_Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Take:
    """One motion of a person in one outfit.

    Attributes:
        name: as the capture calls it.
        split: what it is for.
        cameras: name to camera, all of them.
        training_cameras, heldout_cameras: names; held-out ones are for judging novel views.
        frames: numbers of the frames that have image, mask and pose for every training camera, ascending.
        poses: row = frame number.
        views: (camera name, frame) to files, for all cameras.
        calibration_files, pose_files: what `cameras` and `poses` were read from.
        scan, scan_frame: a mesh of the dressed person and the frame it shows.
        notes: what was left out or assumed, in sentences for people.
        scans: frame to scan, for captures that have one of every frame.
        posed: whether the capture brings poses; without them `poses` are rest poses that mean nothing.
    """

    name: str
    split: Split
    cameras: Mapping[str, Camera]
    training_cameras: tuple[str, ...]
    heldout_cameras: tuple[str, ...]
    frames: list[int]
    poses: Poses
    views: TakeViews
    calibration_files: tuple[Path, ...] = ()
    pose_files: tuple[Path, ...] = ()
    scan: Path | None = None
    scan_frame: int | None = None
    notes: tuple[str, ...] = ()
    posed: bool = True
    scans: Mapping[int, Path] = field(default_factory=dict)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.poses.fps

    def camera(self, camera: str | Camera) -> Camera:
        """The camera of that name."""
        name = camera.name if isinstance(camera, Camera) else camera
        if name not in self.cameras:
            raise UsageProblem(
                f"There is no camera called {name!r} in {self.name}.",
                "camera " + name,
                "Choose one of: " + ", ".join(self.cameras) + ".",
            )
        return self.cameras[name]

    def has_image(self, camera: str | Camera, frame: int) -> bool:
        """Whether image and mask of that view exist."""
        name = camera.name if isinstance(camera, Camera) else camera
        return (name, frame) in self.views

    def view(self, camera: str | Camera, frame: int) -> ViewFiles:
        """The files of one view; MissingInput when there are none."""
        name = self.camera(camera).name
        try:
            return self.views[name, frame]
        except KeyError:
            raise MissingInput(
                f"{self.name} has no image of frame {frame} by camera {name}.",
                f"{self.name}, {name}, frame {frame}",
                "Choose a frame that was captured: " + _some(self.frames) + ".",
            ) from None

    def image(self, camera: str | Camera, frame: int) -> _Image:
        """(H, W, 3) u8 sRGB."""
        path, seen_by = self.view(camera, frame).image, self.camera(camera)
        return check_size(read_image(path), seen_by.width, seen_by.height, path)

    def mask(self, camera: str | Camera, frame: int) -> _Image:
        """(H, W) u8, coverage by the person, 0 to 255."""
        path, seen_by = self.view(camera, frame).mask, self.camera(camera)
        return check_size(read_mask(path), seen_by.width, seen_by.height, path)

    def labels(self, camera: str | Camera, frame: int) -> _Image | None:
        """(H, W) u8 ids of `LABELS`, 255 where there is nothing; None when this view has no label image."""
        path, seen_by = self.view(camera, frame).labels, self.camera(camera)
        if path is None:
            return None
        return check_size(read_labels(path), seen_by.width, seen_by.height, path)

    def read_scan(self) -> Mesh | None:
        """The mesh of the dressed person at `scan_frame`, with its colours and labels; None without a scan.

        Raises:
            BadData: as `load_mesh`.
        """
        if self.scan is None:
            return None
        if self.scan.suffix == ".pkl":
            return read_scan(self.scan)
        return load_mesh(self.scan)

    def subject_box(self, camera: str | Camera, frame: int, margin: int = 8) -> Box | None:
        """Smallest box (left, top, right, bottom) around the mask, `margin` pixels wider, inside the image.

        It is None where the mask shows nobody.
        """
        return box_around(self.mask(camera, frame) > MASK_THRESHOLD, margin)

    def empty_mask(self, camera: str | Camera, frame: int) -> BadData:
        """The error for a view whose mask shows nobody."""
        return BadData(
            "The mask is empty: no pixel above 127.",
            str(self.view(camera, frame).mask),
            "Make the mask again, or take this frame out of the capture.",
        )


def box_around(inside: NDArray[np.bool_], margin: int) -> Box | None:
    """The box (left, top, right, bottom) around the true pixels of (H, W), widened, inside the image.

    It is None where no pixel is true.
    """
    columns, rows = np.flatnonzero(inside.any(axis=0)), np.flatnonzero(inside.any(axis=1))
    if not len(rows):
        return None
    height, width = inside.shape
    return (
        max(0, int(columns[0]) - margin),
        max(0, int(rows[0]) - margin),
        min(width, int(columns[-1]) + 1 + margin),
        min(height, int(rows[-1]) + 1 + margin),
    )


@dataclass(frozen=True, eq=False)
class Capture:
    """All takes of one person in one outfit.

    Attributes:
        root: the folder that was opened.
        format: its layout.
        takes: in the order of their names.
        body_model_path: body model that came with the capture, if any.
        label_folder: folder of label images that `gw label` made for a subject; None without them.
    """

    root: Path
    format: str
    takes: tuple[Take, ...]
    body_model_path: Path | None = None
    label_folder: Path | None = None

    @property
    def training_takes(self) -> tuple[Take, ...]:
        """Takes to learn from."""
        return tuple(take for take in self.takes if take.split == "train")

    @property
    def test_takes(self) -> tuple[Take, ...]:
        """Takes to judge by."""
        return tuple(take for take in self.takes if take.split == "test")

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out or assumed, each sentence once."""
        return tuple(dict.fromkeys(f"{take.name}: {note}" for take in self.takes for note in take.notes))

    def take(self, name: str) -> Take:
        """The take of that name."""
        for take in self.takes:
            if take.name == name:
                return take
        raise UsageProblem(
            f"The capture has no take called {name!r}.",
            str(self.root),
            "Choose one of: " + ", ".join(take.name for take in self.takes) + ".",
        )

    def files(self, group: str, split: Split | None = None) -> list[Path]:
        """The files of a group (`GROUPS`), of frames that can be used, sorted; of one split or of both.

        Images, masks and labels count for every camera, held-out ones included.
        """
        takes = [take for take in self.takes if split in (None, take.split)]
        if group == "body":
            found = {self.body_model_path} if self.body_model_path else set()
        elif group == "cameras":
            found = {path for take in takes for path in take.calibration_files}
        elif group == "poses":
            found = {path for take in takes for path in take.pose_files}
        elif group == "scan":
            found = {take.scan for take in takes if take.scan}
        elif group in ("images", "masks", "labels"):
            found = {
                files[frame]
                for take in takes
                for views in take.views.cameras.values()
                for frame in take.frames
                if frame in views and frame in (files := getattr(views, group))
            }
        else:
            raise ValueError(f"no group of files is called {group!r}; there are {GROUPS}")
        return sorted(found)


def _some(frames: list[int]) -> str:
    if len(frames) <= 6:
        return ", ".join(map(str, frames))
    return ", ".join(map(str, frames[:5])) + f", … {frames[-1]} ({len(frames)} frames)"

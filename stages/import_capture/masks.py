"""Where the masks of a capture come from: a folder, alpha, the empty scene, or a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.import_capture import pictures, videos
from stages.import_capture.config import ImportConfig
from stages.import_capture.media import Recording, by_camera, find_recordings
from stages.import_capture.pictures import read_grey, read_picture
from stages.shared.errors import MissingInput, UsageProblem
from stages.shared.vision.background import background_model, mask_from_background
from stages.shared.vision.models import INSTALL, problem

_Image = NDArray[np.uint8]
_FOLDERS = ("masks", "mask", "../masks")
_BACKGROUND_PICTURES = 15  # of a video of the empty scene
SOURCES = (
    "a folder masks/<camera>/<frame>.png, pictures with an alpha channel, a picture of the empty scene "
    "(--background), or the extra vision"
)


@dataclass(frozen=True, eq=False)
class MaskSource:
    """How masks are made.

    Attributes:
        kind: "folder", "alpha", "background" or "network".
        folders: camera to its folder of masks.
        models: camera to median and noise of the empty scene.
    """

    kind: str
    folders: Mapping[str, Path] = field(default_factory=dict)
    models: Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=dict)

    def mask(self, camera: str, number: int, stem: str, image: _Image, alpha: _Image | None) -> _Image | None:
        """(H, W) u8 coverage of one distorted picture; None where a network makes it, or it is missing.

        Arguments:
            number: of the frame in its recording. stem: of the picture's name, for masks of the same name.
        """
        if self.kind == "alpha":
            return alpha
        if self.kind == "background":
            median, noise = self.models[camera]
            return mask_from_background(image, median, noise)
        if self.kind == "folder":
            path = _mask_file(self.folders[camera], number, stem)
            return None if path is None else read_grey(path)
        return None


def choose_masks(
    source: Path, recordings: Mapping[str, Recording], config: ImportConfig, has_alpha: bool
) -> MaskSource:
    """The source that was asked for; with "auto" the first that is there.

    Raises:
        MissingInput: there is none, or not the one that was asked for.
        UsageProblem: no background given for "background".
    """
    kind = config.masks
    if kind == "background" and config.background is None:
        raise UsageProblem("There is no picture of the empty scene.", "option --masks", "Give --background.")
    if config.background is not None and kind in ("auto", "background"):
        return MaskSource("background", models=_background_models(config.background, recordings))
    if kind in ("auto", "folder"):
        folders = _mask_folders(source, recordings)
        if folders:
            return MaskSource("folder", folders)
        if kind == "folder":
            raise MissingInput("There are no masks.", f"{source}: masks/<camera>/", f"Give {SOURCES}.")
    if kind in ("auto", "alpha"):
        if has_alpha:
            return MaskSource("alpha")
        if kind == "alpha":
            raise MissingInput("The pictures have no alpha channel.", str(source), f"Give {SOURCES}.")
    reason = problem()
    if reason is not None:
        raise MissingInput(
            "There is nothing to make masks from.", f"{source}; {reason}", f"Give {SOURCES}. {INSTALL}."
        )
    return MaskSource("network")


def _mask_folders(source: Path, recordings: Mapping[str, Recording]) -> dict[str, Path]:
    for name in _FOLDERS:
        folder = source / name
        if not folder.is_dir():
            continue
        found = {
            camera: folder / part
            for camera, one in recordings.items()
            for part in (camera, one.name)
            if (folder / part).is_dir()
        }
        if len(found) == len(recordings):
            return found
        if all(_mask_file(folder, 0, one.name) for one in recordings.values()):
            return dict.fromkeys(recordings, folder)
    return {}


def _mask_file(folder: Path, number: int, stem: str) -> Path | None:
    names = [f"{stem}{suffix}" for suffix in pictures.SUFFIXES]
    names += [f"{number:0{digits}d}{suffix}" for digits in (6, 5, 8, 4, 1) for suffix in pictures.SUFFIXES]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _background_models(
    place: Path, recordings: Mapping[str, Recording]
) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Median and noise of the empty scene of every camera; one picture serves a single camera."""
    if place.is_dir():
        empty, _ = by_camera(find_recordings(place), recordings)
        missing = sorted(set(recordings) - set(empty))
        if missing:
            raise MissingInput(
                f"The empty scene is not shown by camera {missing[0]}.",
                str(place),
                "Give a picture or video of the empty scene by every camera, named as the cameras.",
            )
        return {camera: background_model(_pictures(one)) for camera, one in empty.items()}
    if len(recordings) > 1:
        raise UsageProblem(
            f"One file cannot be the empty scene of {len(recordings)} cameras.",
            f"option --background {place}",
            "Give a folder with a picture or video of the empty scene by every camera.",
        )
    return {camera: background_model([read_picture(place)[0]]) for camera in recordings}


def _pictures(recording: Recording) -> list[_Image]:
    rows = np.unique(np.linspace(0, recording.count - 1, _BACKGROUND_PICTURES).astype(int))
    if recording.video is not None:
        wanted = {int(row): [int(row)] for row in rows}
        return [image for _, image in videos.read_frames(recording.video, wanted)]
    return [read_picture(recording.files[row])[0] for row in rows]

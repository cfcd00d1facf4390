"""Which files show which frame: folders are listed once, and paths are made when they are asked for.

A studio's capture has some 500,000 files. Making a path object of each takes longer than listing them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path

from stages.shared.errors import BadData
from stages.shared.input_files import read_text

MISSING_LIST = "missing_img_files.txt"
_MAX_NAMES = 1_000_000
_MAX_DIGITS = 9


@dataclass(frozen=True)
class ViewFiles:
    """Where the picture of one frame by one camera is."""

    image: Path
    mask: Path
    labels: Path | None = None


class NumberedFiles(Mapping[int, Path]):
    """Frame number to file, of the files in one folder.

    Attributes:
        folder: where they are. names: frame number to the name of the file.
    """

    def __init__(self, folder: Path, names: Mapping[int, str]) -> None:
        self.folder, self.names = folder, names

    def __getitem__(self, frame: int) -> Path:
        return self.folder / self.names[frame]

    def __contains__(self, frame: object) -> bool:
        return frame in self.names

    def __iter__(self) -> Iterator[int]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def renumbered(self, numbers: Mapping[int, int]) -> NumberedFiles:
        """The same files under other frame numbers, old to new; files of other frames are left out."""
        names = {numbers[frame]: name for frame, name in self.names.items() if frame in numbers}
        return NumberedFiles(self.folder, names)


def numbered_files(folder: Path, pattern: re.Pattern[str]) -> NumberedFiles:
    """Files by frame number (group 1 of `pattern`, for the whole name); empty without a folder.

    Raises:
        BadData: two files of one frame; more than a million frames.
    """
    names: dict[int, str] = {}
    for entry in os.scandir(folder) if folder.is_dir() else ():
        name = entry.name
        match = pattern.fullmatch(name)
        if not match or len(match[1]) > _MAX_DIGITS:
            continue
        frame = int(match[1])
        if frame in names:
            raise BadData(
                f"Two files are of frame {frame}.",
                f"{folder}: {names[frame]} and {name}",
                "Remove the one that is not meant.",
            )
        names[frame] = name
        if len(names) > _MAX_NAMES:
            raise BadData("The folder holds more than a million frames.", str(folder), "Split the capture.")
    return NumberedFiles(folder, names)


class MissingList:
    """Images and masks that `missing_img_files.txt` says are not there or not to be used.

    Attributes:
        entries: paths as the list has them, with slashes.
    """

    def __init__(self, folder: Path, entries: list[str]) -> None:
        self.entries = entries
        self._unmatched = {_plain(folder / entry) for entry in entries}
        self._names: dict[Path, set[str]] = {}
        for path in self._unmatched:
            self._names.setdefault(path.parent, set()).add(path.name)

    @classmethod
    def read(cls, folder: Path) -> MissingList:
        """The list in a folder, one path a line, relative to the folder; it may be absent."""
        path = folder / MISSING_LIST
        if not path.is_file():
            return cls(folder, [])
        lines = read_text(path, "a list of images", errors="replace").splitlines()
        entries = (line.strip().replace("\\", "/") for line in lines)
        return cls(folder, [entry for entry in entries if entry and not entry.startswith("#")])

    def frames_of(self, files: NumberedFiles, frames: Set[int]) -> set[int]:
        """Those of `frames` whose file is listed; the entries count as matched."""
        folder = _plain(files.folder)
        listed = self._names.get(folder)
        if not listed:
            return set()
        left_out = {frame for frame in frames if files.names[frame] in listed}
        self._unmatched -= {folder / files.names[frame] for frame in left_out}
        return left_out

    def notes(self) -> list[str]:
        """A sentence about entries that no file was left out for; call it when all views were asked for."""
        if not self._unmatched:
            return []
        return [
            f"{len(self._unmatched)} of {len(self.entries)} entries of {MISSING_LIST} match no image with a "
            f"mask, such as {min(self._unmatched).name}."
        ]


def _plain(path: Path) -> Path:
    """A path without "..", so that paths can be compared."""
    return Path(os.path.normpath(path))


class CameraViews(Mapping[int, ViewFiles]):
    """Frame number to the files of one camera: the frames that have both image and mask.

    Attributes:
        images, masks, labels: the files of each kind.
    """

    def __init__(
        self,
        images: NumberedFiles,
        masks: NumberedFiles,
        labels: NumberedFiles,
        missing: MissingList | None = None,
    ) -> None:
        self.images, self.masks, self.labels = images, masks, labels
        frames = images.names.keys() & masks.names.keys()
        if missing is not None:
            frames -= missing.frames_of(images, frames) | missing.frames_of(masks, frames)
        self._frames = sorted(frames)
        self._known = frozenset(frames)

    def __getitem__(self, frame: int) -> ViewFiles:
        if frame not in self._known:
            raise KeyError(frame)
        return ViewFiles(self.images[frame], self.masks[frame], self.labels.get(frame))

    def __contains__(self, frame: object) -> bool:
        return frame in self._known

    def __iter__(self) -> Iterator[int]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def labelled(self) -> bool:
        """Whether any view has a label image."""
        return not self._known.isdisjoint(self.labels.names)


class TakeViews(Mapping[tuple[str, int], ViewFiles]):
    """(camera name, frame) to files, for all cameras of a take."""

    def __init__(self, cameras: Mapping[str, CameraViews]) -> None:
        self.cameras = cameras

    def __getitem__(self, view: tuple[str, int]) -> ViewFiles:
        camera, frame = view
        return self.cameras[camera][frame]

    def __contains__(self, view: object) -> bool:
        return isinstance(view, tuple) and view[0] in self.cameras and view[1] in self.cameras[view[0]]

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return ((camera, frame) for camera, views in self.cameras.items() for frame in views)

    def __len__(self) -> int:
        return sum(map(len, self.cameras.values()))

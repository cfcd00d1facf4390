"""The pictures of one camera in the order of the take: read, undistorted, with mask and landmarks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.import_capture import videos
from stages.import_capture.masks import MaskSource
from stages.import_capture.media import Recording
from stages.import_capture.pictures import read_picture
from stages.shared.calibration.undistort import Undistortion
from stages.shared.errors import BadData
from stages.shared.vision.people import Person, PersonFinder, Square

_Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Frame:
    """One row of the take by one camera.

    Attributes:
        row: of the take. image: (H, W, 3) u8 sRGB, undistorted. mask: (H, W) u8; None where there is none.
        person: landmarks, where they were looked for and found.
    """

    row: int
    image: _Image
    mask: _Image | None
    person: Person | None


def first_picture(recording: Recording) -> tuple[_Image, _Image | None]:
    """The first picture of a recording, distorted, and its alpha."""
    if recording.video is None:
        return read_picture(recording.files[0])
    return next(image for _, image in videos.read_frames(recording.video, {0: [0]})), None


def camera_frames(
    camera: str,
    recording: Recording,
    rows: Sequence[int | None],
    lens: Undistortion,
    masks: MaskSource,
    finder: PersonFinder | None,
) -> Iterator[Frame]:
    """Every row of the take that this camera shows.

    Arguments:
        rows: frame of the recording in every row of the take, None where there is none.

    Raises:
        BadData: a picture of another size than the first.
    """
    square: Square | None = None
    for row, number, image, alpha in _raw(recording, rows):
        size = (image.shape[1], image.shape[0])
        if size != (lens.camera.width, lens.camera.height):
            raise BadData(
                f"A picture has {size[0]} x {size[1]} pixels, the first one {lens.camera.width} x "
                f"{lens.camera.height}.",
                f"camera {camera}, frame {number} of {recording.path}",
                "Give pictures of one size.",
            )
        stem = recording.files[number].stem if recording.files else f"{number:06d}"
        mask = masks.mask(camera, number, stem, image, alpha)
        if mask is not None and mask.shape != image.shape[:2]:
            raise BadData(
                f"A mask has {mask.shape[1]} x {mask.shape[0]} pixels, its picture {size[0]} x {size[1]}.",
                f"camera {camera}, frame {number}",
                "Give masks of the pictures' size.",
            )
        straight = lens.picture(image)
        person = None if finder is None else finder(straight, square)
        square = None if person is None else person.square
        if masks.kind == "network":
            mask = None if person is None else person.mask
        else:
            mask = None if mask is None else lens.mask(mask)
        yield Frame(row, straight, mask, person)


def _raw(
    recording: Recording, rows: Sequence[int | None]
) -> Iterator[tuple[int, int, _Image, _Image | None]]:
    """Row of the take, number in the recording, picture and alpha."""
    if recording.video is None:
        for row, number in enumerate(rows):
            if number is not None:
                yield row, number, *read_picture(recording.files[number])
        return
    wanted: dict[int, list[int]] = {}
    for row, number in enumerate(rows):
        if number is not None:
            wanted.setdefault(number, []).append(row)
    for row, image in videos.read_frames(recording.video, wanted):
        number = rows[row]
        assert number is not None
        yield row, number, image, None

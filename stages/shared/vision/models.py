"""Where the networks are: in an installed mediapipe, in its wheel, or in a folder.

`mediapipe==0.10.21` carries the networks as files (Apache 2.0). Its requirements exclude NumPy 2, and gw
needs none of them: the package is never imported. It is installed without requirements, or only downloaded.
"""

from __future__ import annotations

import os
import zipfile
from importlib import metadata
from pathlib import Path

from stages.shared.errors import MissingInput
from stages.shared.input_files import read_input

DETECTOR = "mediapipe/modules/pose_detection/pose_detection.tflite"
LANDMARKS = "mediapipe/modules/pose_landmark/pose_landmark_full.tflite"
VARIABLE = "GW_VISION_MODELS"
_LIMIT = 64 << 20
INSTALL = (
    'Install the extra: pip install "gaussian-wardrobe[vision]" and pip install --no-deps mediapipe==0.10.21 '
    f"(or set {VARIABLE} to its wheel)"
)


def model_bytes(name: str) -> bytes:
    """The content of one network.

    Arguments:
        name: `DETECTOR` or `LANDMARKS`.

    Raises:
        MissingInput: it is nowhere.
        BadData: it is no regular file.
    """
    place = os.environ.get(VARIABLE)
    if place:
        return _from_place(Path(place), name)
    try:
        path = Path(str(metadata.distribution("mediapipe").locate_file(name)))
    except metadata.PackageNotFoundError:
        raise _missing("package mediapipe") from None
    if not path.is_file():
        raise _missing(str(path))
    return read_input(path, "a network", _LIMIT)


def problem() -> str | None:
    """Why networks cannot be used here, in one sentence; None if they can."""
    try:
        model_bytes(DETECTOR)
        model_bytes(LANDMARKS)
        import ai_edge_litert.interpreter  # noqa: F401
    except MissingInput as error:
        return f"{error.what} ({error.where})"
    except ImportError as error:
        return f"The package ai-edge-litert cannot be loaded ({error})."
    return None


def _from_place(place: Path, name: str) -> bytes:
    if place.is_dir():
        path = place / name
        path = path if path.is_file() else place / Path(name).name
        if path.is_file():
            return read_input(path, "a network", _LIMIT)
    elif zipfile.is_zipfile(place):
        with zipfile.ZipFile(place) as wheel:
            if name in wheel.namelist() and wheel.getinfo(name).file_size <= _LIMIT:
                return wheel.read(name)
    raise _missing(f"{VARIABLE}={place}")


def _missing(where: str) -> MissingInput:
    return MissingInput("The networks for people in pictures are not here.", where, INSTALL + ".")

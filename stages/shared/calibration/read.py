"""Which kind of calibration a file or folder holds, and its cameras."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from stages.shared.calibration.colmap import is_colmap, read_colmap
from stages.shared.calibration.json_cameras import read_json_cameras
from stages.shared.calibration.model import Calibration
from stages.shared.calibration.opencv_yml import is_opencv, read_opencv
from stages.shared.calibration.qualisys import is_qualisys, read_qualisys
from stages.shared.calibration.table import read_table
from stages.shared.errors import MissingInput

KINDS = (
    "COLMAP (cameras.txt or .bin with images)",
    "EasyMocap (intri.yml, extri.yml)",
    "OpenCV (one .yml a camera)",
    "nerfstudio (transforms.json)",
    "Qualisys (.qca.txt)",
    "AvatarReX or MVHumanNet (.json)",
    "a table (calibration.txt)",
)
_NAMES = (
    "calibration", "calibration.txt", "calibration.json", "calibration_full.json", "cameras.json",
    "transforms.json", "cameras", "sparse/0", "sparse", "colmap/sparse/0",
)  # fmt: skip


def read_calibration(path: Path) -> Calibration:
    """The cameras of a file or folder of any kind that is known.

    Raises:
        MissingInput: nothing there, or nothing known in the folder.
        BadData: damaged.
    """
    if not path.exists():
        raise MissingInput("There is no such calibration.", str(path), "Check the path.")
    reader = _reader(path)
    if reader is None:
        raise MissingInput(
            "No calibration of a known kind is here.", str(path), "Known are: " + "; ".join(KINDS) + "."
        )
    return reader(path)


def find_calibration(source: Path) -> Path | None:
    """The calibration in a folder of pictures or videos, or in one of its usual sub-folders."""
    for folder in (source, source.parent):
        for path in sorted(folder.glob("*.qca.txt")):
            return path
        if is_colmap(folder) or (folder / "intri.yml").is_file():
            return folder
        for name in _NAMES:
            path = folder / name
            if path.exists() and _reader(path) is not None:
                return path
    return None


def _reader(path: Path) -> Callable[[Path], Calibration] | None:
    if path.is_dir():
        if is_colmap(path):
            return read_colmap
        qualisys = sorted(path.glob("*.qca.txt"))
        if qualisys:
            return lambda _: read_qualisys(qualisys[0])
        return read_opencv if is_opencv(path) else None
    if is_qualisys(path):
        return read_qualisys
    if path.suffix.lower() == ".json":
        return read_json_cameras
    if is_opencv(path):
        return read_opencv
    if path.name in ("cameras.txt", "cameras.bin", "images.txt", "images.bin") and is_colmap(path.parent):
        return lambda file: read_colmap(file.parent)
    return read_table if path.suffix.lower() in (".txt", ".csv", ".dat") else None

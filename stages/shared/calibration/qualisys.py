"""Qualisys Track Manager's `.qca.txt`: intrinsics in 1/64 pixel, millimetres, z up, cameras look along -z."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from stages.shared.calibration.model import Calibration, LensCamera, lens_camera
from stages.shared.errors import BadData
from stages.shared.input_files import read_text

_SUBPIXELS = 64.0
_METRES_PER_UNIT = 0.001
_LIMIT = 16 << 20


def is_qualisys(path: Path) -> bool:
    """Whether a file is named as Qualisys names its calibrations."""
    return path.name.lower().endswith((".qca.txt", ".qca"))


def read_qualisys(path: Path) -> Calibration:
    """The video cameras of a calibration.

    The matrix r11 to r33 turns world directions into the camera's, whose y points up and whose z points
    backward; (x, y, z) is where the camera stands.

    Raises:
        BadData: not this kind of XML, a camera without transform or intrinsics, a rotated view.
    """
    text = read_text(path, "a Qualisys calibration", _LIMIT)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise BadData("The file defines entities.", str(path), "Export the calibration again.")
    try:
        root = ElementTree.fromstring(text.encode())
    except ElementTree.ParseError as error:
        raise BadData(
            f"This is no XML file ({error}).", str(path), "Export the calibration from QTM again."
        ) from error
    cameras: dict[str, LensCamera] = {}
    for entry in root.iter("camera"):
        name = entry.get("serial") or f"camera{len(cameras) + 1}"
        where = f"{path}: camera {name}"
        if entry.get("active", "1") != "1":
            continue
        if entry.get("viewrotation", "0") not in ("0", ""):
            raise BadData(
                f"The view of camera {name} is rotated by {entry.get('viewrotation')} degrees.",
                where,
                "Export the calibration with viewrotation 0.",
            )
        transform, lens = entry.find("transform"), entry.find("intrinsic")
        field = entry.find("fov_video_max")
        if transform is None or lens is None:
            raise BadData(f"Camera {name} has no transform or no intrinsic.", where, "Export it again.")
        try:
            turn = np.array(
                [[float(transform.attrib[f"r{row}{column}"]) for column in (1, 2, 3)] for row in (1, 2, 3)]
            )
            centre = np.array([float(transform.attrib[axis]) for axis in "xyz"])
            values = {key: float(lens.attrib[key]) / _SUBPIXELS for key in (
                "focalLengthU", "focalLengthV", "centerPointU", "centerPointV")}  # fmt: skip
            skew = float(lens.get("skew", "0")) / _SUBPIXELS
            distortion = [
                float(lens.get(key, "0"))
                for key in ("radialDistortion1", "radialDistortion2", "tangentalDistortion1",
                            "tangentalDistortion2", "radialDistortion3")
            ]  # fmt: skip
            size = None
            if field is not None:
                size = (
                    int(field.attrib["right"]) - int(field.attrib["left"]) + 1,
                    int(field.attrib["bottom"]) - int(field.attrib["top"]) + 1,
                )
        except (KeyError, ValueError) as error:
            raise BadData(
                f"Camera {name}: a number is missing or wrong ({error}).", where, "Export it again."
            ) from error
        rotation = np.diag([1.0, -1.0, -1.0]) @ turn
        intrinsics: list[list[float]] = [
            [values["focalLengthU"], skew, values["centerPointU"]],
            [0, values["focalLengthV"], values["centerPointV"]],
            [0, 0, 1],
        ]
        pose = np.c_[rotation, -rotation @ centre]
        cameras[name] = lens_camera(name, size, intrinsics, pose, where, distortion)
    if not cameras:
        raise BadData("The file lists no active camera.", str(path), "Export the calibration again.")
    return Calibration(cameras, "Qualisys", (str(path),), _METRES_PER_UNIT, np.array([0.0, 0.0, 1.0]))

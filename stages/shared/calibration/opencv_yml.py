"""Calibrations in OpenCV's YAML: EasyMocap's `intri.yml` and `extri.yml`, or one file a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stages.shared.calibration.model import Calibration, LensCamera, Matrix, lens_camera, pose_from
from stages.shared.errors import BadData
from stages.shared.input_files import read_text

_LIMIT = 16 << 20
# What programs call the same thing; the first that is there counts.
_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "intrinsic", "M")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "dist", "D")
_ROTATION = ("R", "Rot", "rotation", "rvec", "rotation_matrix", "rotation_vector")
_TRANSLATION = ("T", "t", "tvec", "translation", "translation_vector")
_POSE = ("camera_from_world", "extrinsic", "extrinsics", "RT", "pose")
_WIDTH = ("image_width", "image_Width", "width", "W")
_HEIGHT = ("image_height", "image_Height", "height", "H")
_FISHEYE = ("fisheye", "equidistant")


def is_opencv(path: Path) -> bool:
    """Whether a folder has EasyMocap's pair of files, or a file or folder has one YAML file a camera."""
    if path.is_dir():
        return (path / "intri.yml").is_file() or any(path.glob("*.y*ml"))
    return path.suffix.lower() in (".yml", ".yaml", ".xml")


def read_opencv(path: Path) -> Calibration:
    """The cameras of EasyMocap's pair, or of one YAML file a camera in a folder.

    Raises:
        BadData: files that OpenCV cannot read, cameras without pose.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / "intri.yml").is_file():
        return _easymocap(folder / "intri.yml", folder / "extri.yml")
    files = sorted(folder.glob("*.y*ml")) if path.is_dir() else [path]
    cameras = [_one(file) for file in files]
    return Calibration({camera.name: camera for camera in cameras}, "OpenCV", tuple(map(str, files)))


def _easymocap(intrinsics: Path, extrinsics: Path) -> Calibration:
    inner, outer = _storage(intrinsics), _storage(extrinsics)
    node = inner.getNode("names")
    names = [node.at(index).string() for index in range(node.size())]
    if not names:
        raise BadData("The file lists no cameras.", f"{intrinsics}: names", "Add the cameras' names.")
    cameras = {}
    for name in names:
        where = f"{intrinsics.parent}: camera {name}"
        matrix, distortion = _matrix(inner, [f"K_{name}"]), _matrix(inner, [f"dist_{name}", f"D_{name}"])
        rotation = _matrix(outer, [f"Rot_{name}", f"R_{name}"])
        translation = _matrix(outer, [f"T_{name}"])
        if matrix is None or rotation is None or translation is None:
            raise BadData(f"Camera {name} has no K, R or T.", where, "Write the whole calibration.")
        width, height = _number(inner, [f"W_{name}"]), _number(inner, [f"H_{name}"])
        size = (int(width), int(height)) if width and height else None
        pose = pose_from(_rotation(rotation), translation)
        cameras[name] = lens_camera(name, size, matrix, pose, where, () if distortion is None else distortion)
    return Calibration(cameras, "EasyMocap", (str(intrinsics), str(extrinsics)))


def _one(path: Path) -> LensCamera:
    """The camera of one file; the file's name is the camera's."""
    storage = _storage(path)
    matrix, pose = _matrix(storage, _MATRIX), _matrix(storage, _POSE)
    if pose is None:
        rotation, translation = _matrix(storage, _ROTATION), _matrix(storage, _TRANSLATION)
        if rotation is not None and translation is not None:
            pose = pose_from(_rotation(rotation), translation)
    if matrix is None or pose is None:
        raise BadData(
            "The file has no camera matrix, or no pose of the camera.",
            f"{path}: {' | '.join(_MATRIX)}; {' | '.join(_ROTATION)} and {' | '.join(_TRANSLATION)}",
            "Write both: camera_matrix, and R and T from world to camera.",
        )
    distortion = _matrix(storage, _DISTORTION)
    width, height = _number(storage, _WIDTH), _number(storage, _HEIGHT)
    model = storage.getNode("distortion_model")
    fisheye = model.isString() and model.string().lower() in _FISHEYE
    size = (int(width), int(height)) if width and height else None
    return lens_camera(
        path.stem, size, matrix, pose, str(path), () if distortion is None else distortion, fisheye=fisheye
    )


def _storage(path: Path) -> Any:
    text = read_text(path, "an OpenCV calibration", _LIMIT)
    try:
        return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise BadData(
            "OpenCV cannot read this file.", str(path), "It has to begin with %YAML:1.0, as OpenCV writes it."
        ) from error


def _matrix(storage: Any, names: Any) -> Matrix | None:
    for name in names:
        node = storage.getNode(name)
        if node.empty():
            continue
        if node.isSeq():
            return np.array([node.at(index).real() for index in range(node.size())])
        value = node.mat()
        if value is not None:
            return np.asarray(value, np.float64)
    return None


def _number(storage: Any, names: Any) -> float:
    for name in names:
        node = storage.getNode(name)
        if not node.empty() and (node.isInt() or node.isReal()):
            return float(node.real())
    return 0.0


def _rotation(value: Matrix) -> Matrix:
    """(3, 3) out of a matrix or an axis-angle vector."""
    return value if value.size == 9 else np.asarray(cv2.Rodrigues(value.reshape(3, 1))[0])

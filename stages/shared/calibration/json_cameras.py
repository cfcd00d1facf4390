"""Calibrations in JSON: nerfstudio's `transforms.json`, AvatarReX and MVHumanNet, and the native layout."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from stages.shared.calibration.model import Calibration, LensCamera, lens_camera, pose_from
from stages.shared.errors import BadData
from stages.shared.input_files import read_json_object

_INTRINSICS = ("K", "intrinsics", "intrinsic", "camera_matrix")
_DISTORTION = ("distCoeff", "distCoeffs", "dist", "D", "distortion", "dist_k1k2p1p2")
_ROTATION = ("R", "rotation", "R_w2c")
_TRANSLATION = ("T", "t", "translation", "t_w2c")
_NAME_PARTS = ("camera_from_world", "extrinsics", "RT", "w2c")


def read_json_cameras(path: Path) -> Calibration:
    """The cameras of a JSON file of any of the three kinds.

    Raises:
        BadData: neither kind; entries missing or of the wrong shape.
    """
    content = read_json_object(path, "a calibration")
    if isinstance(content.get("frames"), list):
        return _nerfstudio(content, path)
    if isinstance(content.get("cameras"), list):
        entries = {str(entry.get("name", index)): entry for index, entry in enumerate(content["cameras"])}
        return _by_name(entries, path, "gw cameras.json", centres_at_integers=False)
    if isinstance(content.get("cameras"), dict):
        content = content["cameras"]
    entries = {name: entry for name, entry in content.items() if isinstance(entry, dict)}
    if not entries or not any(_first(entry, _INTRINSICS) is not None for entry in entries.values()):
        raise BadData(
            "This JSON file is no calibration that is known.",
            str(path),
            "Known are nerfstudio's transforms.json, AvatarReX (K, R, T, distCoeff) and cameras.json.",
        )
    return _by_name(entries, path, "JSON with K, R, T")


def _by_name(
    entries: dict[str, dict[str, Any]], path: Path, kind: str, centres_at_integers: bool = True
) -> Calibration:
    cameras = {}
    for name, entry in entries.items():
        where = f"{path}: camera {name}"
        pose = _first(entry, _NAME_PARTS)
        rotation, translation = _first(entry, _ROTATION), _first(entry, _TRANSLATION)
        intrinsics = _first(entry, _INTRINSICS)
        if intrinsics is None or (pose is None and (rotation is None or translation is None)):
            raise BadData(
                f"Camera {name} lacks K, or R and T.", where, "Write the whole calibration of this camera."
            )
        try:
            matrix = np.asarray(pose, np.float64) if pose is not None else pose_from(rotation, translation)
            matrix = matrix.reshape(-1, 4)
        except (ValueError, TypeError) as error:
            raise BadData(
                f"Camera {name}: the pose has the wrong shape ({error}).", where, "Write R (3, 3) and T (3)."
            ) from error
        distortion = _first(entry, _DISTORTION)
        cameras[name] = lens_camera(
            name,
            _size(entry),
            intrinsics,
            matrix,
            where,
            () if distortion is None else distortion,
            fisheye=bool(entry.get("fisheye", False)),
            centres_at_integers=centres_at_integers,
        )
    return Calibration(cameras, kind, (str(path),))


def _nerfstudio(content: dict[str, Any], path: Path) -> Calibration:
    """Poses are world-from-camera with OpenGL's axes; lens values stand in a frame or for all of them."""
    cameras: dict[str, LensCamera] = {}
    for number, frame in enumerate(content["frames"]):
        where = f"{path}: frame {number}"
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise BadData(
                "A frame has no transform_matrix.", where, "Write the whole calibration of this frame."
            )
        entry = {**content, **frame}
        model = str(entry.get("camera_model", "OPENCV"))
        if model not in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
            raise BadData(
                f"The camera model {model} cannot be undistorted.", where, "Use OPENCV or OPENCV_FISHEYE."
            )
        missing = [key for key in ("fl_x", "cx", "cy") if not isinstance(entry.get(key), int | float)]
        if missing:
            raise BadData(f"A frame has no {missing[0]}.", where, "Write fl_x, fl_y, cx, cy, w and h.")
        fisheye = model == "OPENCV_FISHEYE"
        order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        try:
            world_from_camera = np.asarray(entry["transform_matrix"], np.float64).reshape(-1, 4)
            world_from_camera = np.vstack([world_from_camera[:3], [0, 0, 0, 1]])
            world_from_camera[:, 1:3] *= -1
            pose = np.linalg.inv(world_from_camera)
        except (ValueError, TypeError, np.linalg.LinAlgError) as error:
            raise BadData(f"transform_matrix is no pose ({error}).", where, "Write 4 x 4 numbers.") from error
        name = _frame_name(frame, content["frames"], number)
        if name in cameras:
            continue  # further images of the same fixed camera
        cameras[name] = lens_camera(
            name,
            _size(entry),
            [[entry["fl_x"], 0, entry["cx"]], [0, entry.get("fl_y", entry["fl_x"]), entry["cy"]], [0, 0, 1]],
            pose,
            where,
            [float(entry.get(key, 0.0)) for key in order],
            fisheye=fisheye,
            centres_at_integers=False,
        )
    return Calibration(cameras, "nerfstudio transforms.json", (str(path),))


def _frame_name(frame: dict[str, Any], frames: list[Any], number: int) -> str:
    """Folder of the image where every camera has one of its own, else the image's name without suffix."""
    paths = [PurePosixPath(str(one.get("file_path", ""))) for one in frames if isinstance(one, dict)]
    path = PurePosixPath(str(frame.get("file_path", number)))
    own_folders = len({one.parent for one in paths}) > 1
    return path.parent.name if own_folders else path.stem or str(number)


def _size(entry: dict[str, Any]) -> tuple[int, int] | None:
    size = entry.get("imgSize") or entry.get("img_size") or entry.get("size")
    if size is None and ("w" in entry or "width" in entry):
        size = [entry.get("w", entry.get("width")), entry.get("h", entry.get("height"))]
    try:
        return None if size is None else (int(size[0]), int(size[1]))
    except (TypeError, ValueError, IndexError):
        return None


def _first(entry: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((entry[name] for name in names if entry.get(name) is not None), None)

"""Camera paths out of a JSON file: keys between which the camera is interpolated, or one camera per frame.

    {"format": "gw-camera-path", "version": 1,
     "keys": [{"frame": 0, "position": [0, 1.2, 3], "target": [0, 1, 0], "field_of_view": 35},
              {"frame": 90, "position": [3, 1.2, 0], "target": [0, 1, 0]}]}

`frame` counts the frames of the sequence from 0 and may be fractional. `position` and `target` are metres in
the world. `field_of_view` is in degrees from top to bottom; the first key's default is 30, that of later keys
is the value of the key before. `up` is [0, 1, 0] by default. Between keys everything follows a smooth curve
through the keys that does not overshoot (Fritsch and Carlson 1980). Before the first and after the last key
the camera does not move.

    {"format": "gw-camera-path", "version": 1,
     "cameras": [{"width": 512, "height": 512, "intrinsics": [[740, 0, 256], [0, 740, 256], [0, 0, 1]],
                  "camera_from_world": [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 3], [0, 0, 0, 1]]}]}

takes matrices as `cameras.json` of a capture does, one per frame; the last one stays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from stages.shared.capture.calibration import checked_camera, refuse_unknown
from stages.shared.capture.camera import Camera
from stages.shared.errors import BadData
from stages.shared.input_files import read_json

_CAMERA_FIELDS = ("width", "height", "intrinsics", "camera_from_world")
FORMAT = "gw-camera-path"
_FIELD_OF_VIEW = 30.0
_LARGEST_FILE = 64 << 20
_MOST_KEYS = 100_000


def path_cameras(path: Path, frames: int, size: tuple[int, int]) -> list[Camera]:
    """One camera per frame of the sequence.

    Arguments:
        size: width, height in pixels, for keys; cameras with matrices state their own.

    Raises:
        MissingInput: no such file. BadData: not a camera path, NaN, a camera that looks along `up`.
    """
    content = _read(path)
    if ("keys" in content) == ("cameras" in content):
        raise _refused('it needs either "keys" or "cameras"', path)
    listed = content["keys"] if "keys" in content else content["cameras"]
    if not isinstance(listed, list) or not 0 < len(listed) <= _MOST_KEYS:
        raise _refused("it names no camera, or too many", path)
    if not all(isinstance(entry, dict) for entry in listed):
        raise _refused("a key is not an object", path)
    if "cameras" in content:
        cameras = [_matrix_camera(entry, index, path) for index, entry in enumerate(listed)]
        return [cameras[min(frame, len(cameras) - 1)] for frame in range(frames)]
    times, values = _keys(listed, path)
    curve = _curve(times, values)
    moments = np.clip(np.arange(frames, dtype=float), times[0], times[-1])
    return [_key_camera(row, size, path) for row in curve(moments)]


def _keys(listed: list[dict[str, Any]], path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (K,), and (K, 10) position, target, up, field of view."""
    times, rows, angle = [], [], _FIELD_OF_VIEW
    for index, key in enumerate(listed):
        unknown = sorted(key.keys() - {"frame", "position", "target", "up", "field_of_view"})
        if unknown:
            raise _refused(f"key {index} has {unknown[0]!r}, which means nothing", path)
        try:
            angle = float(key.get("field_of_view", angle))
            row = [*_point(key["position"]), *_point(key["target"]), *_point(key.get("up", [0, 1, 0])), angle]
            times.append(float(key["frame"]))
        except (KeyError, TypeError, ValueError) as error:
            raise _refused(f"key {index} needs frame, position and target ({error})", path) from error
        rows.append(row)
    values = np.array(rows)
    if not np.isfinite(values).all() or not np.isfinite(times).all():
        raise _refused("a number is not finite", path)
    if (np.diff(times) <= 0).any():
        raise _refused("its frames do not ascend", path)
    if (values[:, 9] <= 0).any() or (values[:, 9] >= 179).any():
        raise _refused("a field of view is not between 0 and 179 degrees", path)
    return np.array(times), values


def _point(value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError("three numbers make a point")
    return [float(number) for number in value]


def _curve(times: NDArray[np.float64], values: NDArray[np.float64]) -> Any:
    if len(times) == 1:
        return lambda moments: np.repeat(values, len(moments), axis=0)
    return PchipInterpolator(times, values, axis=0)


def _key_camera(row: NDArray[np.float64], size: tuple[int, int], path: Path) -> Camera:
    """The camera of position, target, up and field of view (10,)."""
    position, target, up, angle = row[:3], row[3:6], row[6:9], row[9]
    forward = target - position
    length = np.linalg.norm(forward)
    across = np.cross(forward, up)
    if length < 1e-9 or np.linalg.norm(across) < 1e-6 * length * max(float(np.linalg.norm(up)), 1e-9):
        raise _refused("a camera stands on its target or looks along its up direction", path)
    forward, right = forward / length, across / np.linalg.norm(across)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ position
    width, height = size
    focal = 0.5 * height / np.tan(np.deg2rad(angle) / 2)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera("path", width, height, intrinsics, camera_from_world)


def _matrix_camera(entry: dict[str, Any], index: int, path: Path) -> Camera:
    try:
        numbers = entry["width"], entry["height"], entry["intrinsics"], entry["camera_from_world"]
    except KeyError as error:
        raise _refused(f"camera {index} has no {error}", path) from error
    refuse_unknown(entry, _CAMERA_FIELDS, str(path), f"Camera {index}")
    camera = checked_camera(f"{index}", *numbers, str(path))
    return Camera("path", camera.width, camera.height, camera.intrinsics, camera.camera_from_world)


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path, "a camera path", _LARGEST_FILE)
    if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != 1:
        raise _refused(f'it is not marked as "format": "{FORMAT}", "version": 1', path)
    return content


def _refused(what: str, path: Path) -> BadData:
    return BadData(f"The camera path cannot be used: {what}.", str(path), "See gw render --help.")

"""The calibration's world brought to metres and y up, by what is stated or by the person in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.calibration.model import Calibration
from stages.shared.capture.camera import Camera
from stages.shared.errors import BadData

Doubles = NDArray[np.float64]

_UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_SHORTEST, _TALLEST, _USUAL = 1.30, 2.10, 1.70  # metres of stature
_NOSE_TO_ANKLE = 0.876  # of the stature
_NEAREST, _FARTHEST = 0.8, 20.0  # metres between cameras and the middle of them
_SNAP = np.radians(20.0)
_AXES = {
    "+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1),
}  # fmt: skip
_NOSE, _SHOULDERS, _HIPS, _KNEES, _ANKLES = [0], [11, 12], [23, 24], [25, 26], [27, 28]


@dataclass(frozen=True, eq=False)
class World:
    """World from calibration: p ↦ metres · turn · p, and how either was found, for people."""

    turn: Doubles
    metres: float
    notes: tuple[str, ...]

    def camera(self, camera: Camera) -> Camera:
        """The camera in the new world."""
        pose = camera.camera_from_world.copy()
        pose[:3, :3] = pose[:3, :3] @ self.turn.T
        pose[:3, 3] *= self.metres
        return replace(camera, camera_from_world=pose)

    def points(self, points: Doubles) -> Doubles:
        """Points (..., 3) in the new world, metres."""
        return np.asarray(self.metres * points @ self.turn.T, np.float64)


def find_world(
    calibration: Calibration,
    cameras: Mapping[str, Camera],
    points: Doubles | None,
    up: str,
    metres_per_unit: float | None,
) -> World:
    """The world of a capture.

    Arguments:
        cameras: pinholes in the calibration's world.
        points: (T, 33, 3) landmarks in the calibration's world, NaN where unknown; None without.
        up, metres_per_unit: what was asked for ("auto", None).

    Raises:
        BadData: the unit is not stated and cannot be told.
    """
    metres, about_unit = _metres(calibration, list(cameras.values()), points, metres_per_unit)
    direction, about_up = _up(calibration, list(cameras.values()), points, up)
    return World(_turn_to_y(direction), metres, (about_up, about_unit))


def stature(points: Doubles) -> float | None:
    """Height of the person in the landmarks' unit, median over the frames; None when too little is known."""

    def middle(rows: Sequence[int]) -> Doubles:
        return np.asarray(points[:, rows].mean(axis=1), np.float64)

    def length(first: Sequence[int], second: Sequence[int]) -> Doubles:
        sides = np.linalg.norm(points[:, first] - points[:, second], axis=-1)
        return np.asarray(sides.mean(axis=1), np.float64)

    trunk = [middle(_NOSE) - middle(_SHOULDERS), middle(_SHOULDERS) - middle(_HIPS)]
    parts = [np.linalg.norm(way, axis=-1) for way in trunk] + [length(_HIPS, _KNEES), length(_KNEES, _ANKLES)]
    total = np.sum(parts, axis=0)
    known = total[np.isfinite(total)]
    return float(np.median(known) / _NOSE_TO_ANKLE) if len(known) else None


def _metres(
    calibration: Calibration, cameras: list[Camera], points: Doubles | None, asked: float | None
) -> tuple[float, str]:
    if asked is not None:
        return asked, f"1 unit of the calibration is {asked:g} m, as asked"
    if calibration.metres_per_unit is not None:
        value = calibration.metres_per_unit
        return value, f"1 unit of the calibration is {value:g} m, as its format says"
    tall = None if points is None else stature(points)
    if tall is not None:
        for name, value in _UNITS.items():
            if _SHORTEST <= tall * value <= _TALLEST:
                return value, f"the calibration is in {name}: the person is {tall * value:.2f} m tall"
        value = _USUAL / tall
        return (
            value,
            f"1 unit of the calibration is {value:.4g} m: the person is taken as {_USUAL:.2f} m tall",
        )
    centres = np.stack([camera.centre for camera in cameras])
    away = float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))
    if _NEAREST <= away <= _FARTHEST:
        return 1.0, f"the calibration is taken as metres: the cameras stand {away:.1f} from their middle"
    raise BadData(
        f"The unit of the calibration is not stated; the cameras stand {away:.3g} units from their middle.",
        ", ".join(calibration.files[:2]),
        "Give --metres-per-unit (0.001 for millimetres), or install the extra vision: the person tells it.",
    )


def _up(
    calibration: Calibration, cameras: list[Camera], points: Doubles | None, asked: str
) -> tuple[Doubles, str]:
    if asked != "auto":
        return np.array(_AXES[asked], np.float64), f"{asked} is up, as asked"
    if calibration.up is not None:
        return calibration.up, f"{_axis_name(calibration.up)} is up, as the calibration's format says"
    direction, source = _guessed_up(cameras, points)
    for name, axis in _AXES.items():
        if direction @ axis > np.cos(_SNAP):
            return np.array(axis, np.float64), f"{name} is up, as {source} says"
    x, y, z = direction
    return direction, f"({x:.2f}, {y:.2f}, {z:.2f}) is up, as {source} says"


def _guessed_up(cameras: list[Camera], points: Doubles | None) -> tuple[Doubles, str]:
    if points is not None:
        way = points[:, _SHOULDERS].mean(axis=1) - points[:, _ANKLES].mean(axis=1)
        way = way[np.isfinite(way).all(axis=1)]
        if len(way):
            mean = way.mean(axis=0)
            return mean / np.linalg.norm(mean), "the person"
    mean = np.mean([-camera.camera_from_world[1, :3] for camera in cameras], axis=0)
    return mean / max(float(np.linalg.norm(mean)), 1e-9), "the cameras' upright"


def _turn_to_y(direction: Doubles) -> Doubles:
    """(3, 3) the smallest rotation that turns a unit direction to +y."""
    target = np.array([0.0, 1.0, 0.0])
    axis, cosine = np.cross(direction, target), float(direction @ target)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix(), np.float64)


def _axis_name(direction: Doubles) -> str:
    return next(name for name, axis in _AXES.items() if direction @ axis > 0.999)

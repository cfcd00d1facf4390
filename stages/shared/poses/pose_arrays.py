"""Arrays of a pose file as frames of joints or rows of values: shapes are checked before anything is read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import MAX_FRAMES
from stages.shared.errors import BadData

Doubles = NDArray[np.float64]

_MATRIX_TOLERANCE = 1e-2
METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
KNOWN_LAYOUTS = (
    "Give a smpl_params.npz (body_pose, global_orient, transl), an AMASS file (poses, trans), or a BVH file; "
    "see docs/formats.md."
)


@dataclass(frozen=True)
class PoseUnits:
    """What a file does not state about itself.

    Attributes:
        degrees: angles are degrees instead of radians.
        metres: length of the file's unit of translation.
        fps: frame rate of the file; None takes the one that it states, else 30.
    """

    degrees: bool = False
    metres: float = 1.0
    fps: float | None = None


@dataclass(frozen=True)
class PoseArrays:
    """Typed access to the arrays of one file; T is the number of frames."""

    file: NumericNpz
    units: PoseUnits = PoseUnits()

    def joints(self, name: str, counts: tuple[int, ...], frames: int | None = None) -> Doubles:
        """The array as (T, J, 3) axis-angle in radians, J one of `counts`; matrices are converted."""
        shape = self.shape(name, frames)
        per_frame = int(np.prod(shape[1:], dtype=object))
        matrices_stored = len(shape) > 2 and shape[-2:] == (3, 3)
        count = next((count for count in counts if per_frame == 3 * count and not matrices_stored), None)
        if count is not None and len(shape) in (2, 3):
            values = self.angles(self.numbers(name))
            return _repeated(values.reshape(len(values), count, 3), frames)
        count = next((count for count in counts if per_frame == 9 * count), None)
        if count is None or len(shape) < 2:
            known = " or ".join(str(3 * count) for count in counts)
            raise self.wrong(
                name, f"{known} axis-angle values, or as many 3 x 3 rotation matrices, per frame"
            )
        matrices = self.numbers(name).reshape(-1, 3, 3)
        off = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero((off > _MATRIX_TOLERANCE) | (np.linalg.det(matrices) < 0))
        if len(wrong):
            frame, joint = divmod(int(wrong[0]), count)
            raise BadData(
                f"{name} holds a 3 x 3 matrix that is not a rotation.",
                f"{self.file.path}: {name}, frame {frame}, joint {joint}",
                "Store rotation matrices, or axis-angle vectors.",
            )
        return _repeated(Rotation.from_matrix(matrices).as_rotvec().reshape(-1, count, 3), frames)

    def rows(self, name: str, columns: int | None, frames: int) -> Doubles:
        """The array as (T, columns); one row stands for all frames."""
        shape = self.shape(name, frames)
        if len(shape) == 1 and columns is not None:
            raise self.wrong(name, f"one row of {columns} values per frame")
        values = self.matrix(name)
        if columns is not None and values.shape[1] != columns:
            raise self.wrong(name, f"one row of {columns} values per frame")
        return _repeated(values, frames)

    def matrix(self, name: str) -> Doubles:
        """The array as (T, values per frame)."""
        shape = self.shape(name)
        if len(shape) < 2:
            raise self.wrong(name, "one row per frame")
        return self.numbers(name).reshape(shape[0], -1)

    def shape(self, name: str, frames: int | None = None) -> tuple[int, ...]:
        """The stored shape, looked at before the array is read: its number of frames is bounded."""
        shape = self.file.shape(name)
        if not shape:
            raise self.wrong(name, "one row per frame")
        if not 0 < shape[0] <= MAX_FRAMES:
            raise BadData(
                f"{name} has {shape[0]} frames.",
                f"{self.file.path}: {name} {shape}",
                f"Give between 1 and {MAX_FRAMES} frames.",
            )
        if frames is not None and shape[0] not in (1, frames):
            raise BadData(
                f"{name} has {shape[0]} rows, the body has {frames} frames.",
                f"{self.file.path}: {name} {shape}",
                "Give one row, or as many as there are frames.",
            )
        return shape

    def numbers(self, name: str) -> Doubles:
        """The array in double precision: finite real numbers."""
        return self.file.numbers(name)

    def angles(self, values: Doubles) -> Doubles:
        """Values of the file's unit of angle, in radians."""
        return np.radians(values) if self.units.degrees else values

    def wrong(self, name: str, expected: str) -> BadData:
        """The error for an array of another shape, which is named as it is stored."""
        return BadData(
            f"{name} has shape {self.file.shape(name)}; expected {expected}.",
            f"{self.file.path}: {name}",
            KNOWN_LAYOUTS,
        )


def _repeated(values: Doubles, frames: int | None) -> Doubles:
    if frames is None or len(values) == frames:
        return values
    return np.repeat(values, frames, axis=0)

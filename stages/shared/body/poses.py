"""A sequence of body poses, and its file layout `smpl_params.npz`."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.skeleton import (
    BODY,
    EXPRESSION_COUNT,
    JAW,
    JOINT_COUNT,
    LEFT_EYE,
    LEFT_HAND,
    RIGHT_EYE,
    RIGHT_HAND,
    SHAPE_COUNT,
)
from stages.shared.errors import BadData

Floats = NDArray[np.float32]

DEFAULT_FPS = 30.0
MAX_FRAMES = 2_000_000
_HAND_VALUES = 45


@dataclass(frozen=True, eq=False)
class Poses:
    """Body parameters of T frames of one person.

    Attributes:
        rotations: (T, 55, 3) f32 axis-angle, radians, relative to the parent joint; SMPL-X order.
        translation: (T, 3) f32 metres; v_world = LBS(β, θ) + translation.
        betas: (10,) f32 shape.
        expression: (T, 10) f32.
        fps: frames per second.
    """

    rotations: Floats
    translation: Floats
    betas: Floats
    expression: Floats
    fps: float = DEFAULT_FPS

    def __post_init__(self) -> None:
        frames = len(self.rotations)
        for name, shape in (
            ("rotations", (frames, JOINT_COUNT, 3)),
            ("translation", (frames, 3)),
            ("betas", (SHAPE_COUNT,)),
            ("expression", (frames, EXPRESSION_COUNT)),
        ):
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if values.shape != shape:
                raise ValueError(f"{name} has shape {values.shape}, expected {shape}")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.rotations)

    def __getitem__(self, frames: int | slice | list[int] | NDArray[np.integer]) -> Poses:
        """The chosen frames; a single number gives a sequence of one frame."""
        rows = [frames] if isinstance(frames, int | np.integer) else frames
        return replace(
            self,
            rotations=self.rotations[rows],
            translation=self.translation[rows],
            expression=self.expression[rows],
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of `smpl_params.npz`: hands as 45 axis-angle values on a flat mean hand."""
        frames = len(self)
        return {
            "betas": self.betas[None],
            "global_orient": self.rotations[:, 0],
            "transl": self.translation,
            "body_pose": self.rotations[:, BODY].reshape(frames, 63),
            "jaw_pose": self.rotations[:, JAW],
            "leye_pose": self.rotations[:, LEFT_EYE],
            "reye_pose": self.rotations[:, RIGHT_EYE],
            "left_hand_pose": self.rotations[:, LEFT_HAND].reshape(frames, _HAND_VALUES),
            "right_hand_pose": self.rotations[:, RIGHT_HAND].reshape(frames, _HAND_VALUES),
            "expression": self.expression,
            "fps": np.array(self.fps, dtype=np.float64),
            "hand_repr": np.array("aa45"),
            "flat_hand_mean": np.array(True),
        }

    def to_npz_bytes(self) -> bytes:
        """The content of a `smpl_params.npz`; the same poses give the same bytes."""
        return npz_bytes(self.to_arrays())

    def save(self, path: Path) -> None:
        """Write `smpl_params.npz`, whole or not at all."""
        from stages.shared.artifacts import write_whole

        write_whole(Path(path), self.to_npz_bytes())


def npz_bytes(arrays: dict[str, NDArray[Any]]) -> bytes:
    """An uncompressed `.npz` with fixed dates and order."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(arrays[name]), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(name + ".npy", (1980, 1, 1, 0, 0, 0)), member.getvalue())
    return buffer.getvalue()


def is_smpl_params(names: frozenset[str]) -> bool:
    """Whether the arrays of an `.npz` are those of a `smpl_params.npz`."""
    return "body_pose" in names


def read_smpl_params(file: NumericNpz, body: BodyModel | None = None) -> Poses:
    """Poses out of an open `smpl_params.npz`.

    Keys: betas (1,10), global_orient, transl (T,3), body_pose (T,63); optional jaw_pose, leye_pose, reye_pose
    (T,3), left_hand_pose and right_hand_pose (T,45) axis-angle or (T,12) coefficients of the body model's
    hand space, expression (T,10), fps, flat_hand_mean. Without `flat_hand_mean` 45 values mean a flat and 12
    values the model's own mean hand, as both are in use. Without fps: 30.

    Raises:
        BadData: missing arrays, other column counts, NaN, 12-value hands and a body without a hand space.
    """
    frames = len(_columns(file, "body_pose", 63))
    rotations = np.zeros((frames, JOINT_COUNT, 3), dtype=np.float32)
    rotations[:, 0] = _columns(file, "global_orient", 3, frames)
    rotations[:, BODY] = _columns(file, "body_pose", 63, frames).reshape(frames, 21, 3)
    for name, joint in (("jaw_pose", JAW), ("leye_pose", LEFT_EYE), ("reye_pose", RIGHT_EYE)):
        if name in file:
            rotations[:, joint] = _columns(file, name, 3, frames)
    for side, joints in (("left", LEFT_HAND), ("right", RIGHT_HAND)):
        if f"{side}_hand_pose" in file:
            rotations[:, joints] = _hand(file, side, frames, body).reshape(frames, 15, 3)
    expression = np.zeros((frames, EXPRESSION_COUNT), dtype=np.float32)
    if "expression" in file:
        given = _columns(file, "expression", None, frames)[:, :EXPRESSION_COUNT]
        expression[:, : given.shape[1]] = given
    fps = DEFAULT_FPS
    if "fps" in file:
        fps = positive_fps(file.array("fps"), file)
    return Poses(rotations, _columns(file, "transl", 3, frames), _betas(file), expression, fps)


def positive_fps(values: NDArray[Any], file: NumericNpz) -> float:
    """One number of frames per second, or BadData."""
    if values.size != 1 or values.dtype.kind not in "iuf" or not 0 < float(values.reshape(())) < 1e5:
        raise BadData(
            "The frame rate is not one positive number.", f"{file.path}: fps", "Store fps as a number."
        )
    return float(values.reshape(()))


def _betas(file: NumericNpz) -> Floats:
    values = np.atleast_2d(_numbers(file, "betas"))
    if values.ndim != 2 or values.shape[1] < 1:
        raise BadData(f"betas has shape {values.shape}.", f"{file.path}: betas", "Store betas as (1, 10).")
    if np.abs(values - values[0]).max() > 1e-3:
        raise BadData(
            "The body shape changes from frame to frame; one person has one shape.",
            f"{file.path}: betas {values.shape}",
            "Store one row of betas (fit the shape once for all frames).",
        )
    betas = np.zeros(SHAPE_COUNT, dtype=np.float32)
    used = values[0, :SHAPE_COUNT]
    betas[: len(used)] = used
    return betas


def _hand(file: NumericNpz, side: str, frames: int, body: BodyModel | None) -> Floats:
    """(T, 45) axis-angle of one hand, whichever of the two ways the file tells it."""
    name = f"{side}_hand_pose"
    values = _columns(file, name, None, frames)
    columns = values.shape[1]
    components = getattr(body, f"hand_components_{side}") if body else None
    mean = getattr(body, f"hand_mean_{side}") if body else None
    flat = columns == _HAND_VALUES
    if "flat_hand_mean" in file:
        flat = bool(file.array("flat_hand_mean").reshape(-1)[0])
    if columns != _HAND_VALUES:
        if columns > _HAND_VALUES or columns == 0:
            raise _wrong_columns(file, name, values.shape, "45 (axis-angle) or 12 (hand coefficients)")
        if not values.any() and flat:
            return np.zeros((frames, _HAND_VALUES), dtype=np.float32)
        if components is None or len(components) < columns:
            raise BadData(
                f"The hands are {columns} coefficients each, and the body model has no hand space.",
                f"{file.path}: {name}",
                "Give the body model of the fit (--body-model), or store 45 axis-angle values per hand.",
            )
        values = values @ components[:columns]
    if not flat:
        if mean is None:
            raise BadData(
                "The hands are relative to a mean hand (flat_hand_mean), which the body model lacks.",
                f"{file.path}: {name}",
                "Give the body model of the fit (--body-model), or add the mean hand to the poses.",
            )
        values = values + mean
    return values.astype(np.float32)


def _columns(file: NumericNpz, name: str, columns: int | None, frames: int | None = None) -> Floats:
    """The array `name` as (T, columns) f32."""
    values = _numbers(file, name)
    if values.ndim > 2:
        values = values.reshape(len(values), -1)
    if values.ndim != 2 or (columns is not None and values.shape[1] != columns):
        raise _wrong_columns(file, name, values.shape, str(columns))
    if frames is not None and len(values) != frames:
        if len(values) != 1:
            raise BadData(
                f"{name} has {len(values)} rows, body_pose has {frames}.",
                f"{file.path}: {name}",
                "Every array but betas needs one row per frame.",
            )
        values = np.repeat(values, frames, axis=0)
    if not 0 < len(values) <= MAX_FRAMES:
        raise BadData(
            f"{name} has {len(values)} frames.",
            f"{file.path}: {name}",
            f"Give between 1 and {MAX_FRAMES} frames.",
        )
    return values


def _numbers(file: NumericNpz, name: str) -> Floats:
    values = file.array(name)
    if values.dtype.kind not in "fiu":
        raise BadData(f"{name} is not numeric.", f"{file.path}: {name}", "Store plain numbers.")
    return values.astype(np.float32)


def _wrong_columns(file: NumericNpz, name: str, shape: tuple[int, ...], expected: str) -> BadData:
    return BadData(
        f"{name} has shape {shape}; expected one row per frame and {expected} columns.",
        f"{file.path}: {name}",
        "Give poses in the SMPL-X layout.",
    )

"""A sequence of body poses, and its file layout `smpl_params.npz`."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

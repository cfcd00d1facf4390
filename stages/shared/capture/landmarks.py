"""Body landmarks of a take: `takes/<name>/landmarks.npz` of the native layout.

Arrays: `cameras` (C,) names, `frames` (T,) numbers, `pixels` (C, T, 33, 2) f32 px with pixel centres at
integer + 0.5 (NaN: not seen), `visibility` (C, T, 33) f32 in [0, 1], `points` (T, 33, 3) f32 m world (NaN:
unknown), `views` (T, 33) i32 views that agree. The order of the 33 landmarks is BlazePose's.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stages.shared.body.npz import NumericNpz
from stages.shared.capture.take import Take
from stages.shared.errors import BadData

FILE: Final = "landmarks.npz"
COUNT: Final = 33


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks of a take; shapes as in the module's first lines."""

    cameras: tuple[str, ...]
    frames: NDArray[np.int64]
    pixels: NDArray[np.float32]
    visibility: NDArray[np.float32]
    points: NDArray[np.float32]
    views: NDArray[np.int32]

    def at(self, frame: int) -> NDArray[np.float64] | None:
        """(33, 3) points of one frame, NaN where unknown; None where the frame has none."""
        rows = np.flatnonzero(self.frames == frame)
        return self.points[rows[0]].astype(np.float64) if len(rows) else None

    def encoded(self) -> bytes:
        """The content of the file."""
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            cameras=np.array(self.cameras),
            frames=self.frames,
            pixels=self.pixels.astype(np.float32),
            visibility=self.visibility.astype(np.float32),
            points=self.points.astype(np.float32),
            views=self.views.astype(np.int32),
        )
        return stream.getvalue()


def landmarks_file(take: Take) -> Path | None:
    """Where the landmarks of a native take are; None where it has none."""
    view = next(iter(take.views.values()), None)
    if view is None:
        return None
    path = view.image.parent.parent.parent / FILE  # takes/<name>/rgb/<camera>/<frame>
    return path if path.is_file() else None


def read_landmarks(path: Path) -> Landmarks:
    """The landmarks in a file.

    Raises:
        BadData: damaged, arrays missing or of shapes that do not belong together.
    """
    with NumericNpz(path, "a landmark file") as file:
        names = tuple(str(name) for name in file.array("cameras").reshape(-1))
        frames = file.array("frames").astype(np.int64).reshape(-1)
        shapes = {
            "pixels": (len(names), len(frames), COUNT, 2),
            "visibility": (len(names), len(frames), COUNT),
            "points": (len(frames), COUNT, 3),
            "views": (len(frames), COUNT),
        }
        arrays = {name: file.array(name, finite=False) for name in shapes}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise BadData(
                f"{name} has the shape {arrays[name].shape}, not {shape}.",
                f"{path}: {name}",
                "Import the capture again.",
            )
    return Landmarks(
        names,
        frames,
        arrays["pixels"].astype(np.float32),
        arrays["visibility"].astype(np.float32),
        arrays["points"].astype(np.float32),
        arrays["views"].astype(np.int32),
    )

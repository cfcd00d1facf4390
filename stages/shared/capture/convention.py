"""The ways people write down a camera's place, and the way from each to `camera_from_world` (OpenCV axes)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from stages.shared.capture.camera import Matrix
from stages.shared.capture.take import Capture, Take
from stages.shared.errors import UsageProblem

AS_IS: Final = "as is"
_TURN_Z = np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up (PyTorch3D)
_TURN_X = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z backward (OpenGL)


def _inverse(matrix: Matrix) -> Matrix:
    return np.asarray(np.linalg.inv(matrix), np.float64)


# What to do to the matrix that the capture gives.
CONVENTIONS: Final[dict[str, Callable[[Matrix], Matrix]]] = {
    AS_IS: lambda matrix: matrix,
    "rows 0 and 1 negated": lambda matrix: _TURN_Z @ matrix,
    "rows 1 and 2 negated": lambda matrix: _TURN_X @ matrix,
    "inverted": _inverse,
    "inverted, rows 0 and 1 negated": lambda matrix: _TURN_Z @ _inverse(matrix),
    "inverted, rows 1 and 2 negated": lambda matrix: _TURN_X @ _inverse(matrix),
}


def take_in_convention(take: Take, convention: str) -> Take:
    """The take with the matrices of its cameras read in another convention."""
    if convention not in CONVENTIONS:
        raise UsageProblem(
            f"There is no camera convention called {convention!r}.",
            "camera convention",
            "Choose one of: " + "; ".join(CONVENTIONS) + ".",
        )
    if convention == AS_IS:
        return take
    change = CONVENTIONS[convention]
    cameras = {
        name: replace(camera, camera_from_world=change(camera.camera_from_world))
        for name, camera in take.cameras.items()
    }
    return replace(take, cameras=cameras)


def capture_in_convention(capture: Capture, convention: str) -> Capture:
    """The capture with the matrices of all cameras read in another convention."""
    return replace(capture, takes=tuple(take_in_convention(take, convention) for take in capture.takes))

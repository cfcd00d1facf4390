"""Axis-angle to matrix for calibrations, in double precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.shared.finite import require_finite


def rotation_of_axis_angle(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation matrix of an axis-angle vector (3,), radians (Rodrigues' formula)."""
    require_finite("rotation_of_axis_angle", axis_angle=vector)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3) + _cross(vector)
    axis = _cross(vector / angle)
    return np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis


def _cross(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])

"""From the world to pixels, and from pixels to values."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from stages.shared.capture import Camera
from stages.shared.capture.projection import sample_bilinear
from stages.shared.finite import finite
from stages.shared.splat.reference import image_covariances, perspective, perspective_jacobian, to_camera
from tests.benchmarks.stability.function import Function, Inputs, unit

_CAMERA = Camera("c", 640, 480, [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], np.eye(4))  # type: ignore[arg-type]
_INTRINSICS = torch.tensor(_CAMERA.intrinsics)


def _ahead(metres: float, random: np.random.Generator) -> Inputs:
    points = unit(random, 40)
    points[:, 2] = 1.0 + 0.1 * random.random(40)
    return {"points": points * metres}


def _project(a: dict[str, Any]) -> np.ndarray:
    """Pixels; −1 where the camera does not see them, as `Camera.project` says by NaN."""
    return np.nan_to_num(_CAMERA.project(a["points"])[0], nan=-1.0)


def _image(pixels: float, random: np.random.Generator) -> Inputs:
    return {"image": random.random((9, 11, 3)), "pixels": pixels * unit(random, 40, 2)}


def _ellipses(metres: float, random: np.random.Generator) -> Inputs:
    spread = random.normal(size=(40, 3, 3)) * 0.01
    return {"covars": spread @ spread.transpose(0, 2, 1), **_ahead(metres, random)}


def _image_covariances(a: dict[str, Any]) -> torch.Tensor:
    viewmat = torch.eye(4, dtype=a["points"].dtype)
    points = to_camera(a["points"], viewmat)
    jacobian = perspective_jacobian(points, _INTRINSICS.to(points), 640, 480)
    return finite(torch.stack(image_covariances(a["covars"], viewmat, jacobian)), "image_covariances", **a)


def _perspective(a: dict[str, Any]) -> torch.Tensor:
    return finite(perspective(a["points"], _INTRINSICS.to(a["points"])), "perspective", **a)


PROJECTION = (
    Function(
        "Camera.project", "projection", "distance, m", (0.0, 1e-30, 1e-6, 1e-2, 1.0, 1e3, 1e6, 1e30), _ahead,
        _project, everyday=(1e-6, 1e6), numpy=True,
    ),
    Function(
        "perspective", "projection", "distance, m", (1e-30, 1e-6, 1e-2, 1.0, 1e3, 1e6, 1e30), _ahead,
        _perspective, everyday=(1e-6, 1e6), tolerance=2e-6, gradients=("points",), bfloat16=True,
    ),
    Function(
        "image_covariances", "projection", "distance, m", (1e-6, 1e-2, 1.0, 1e3, 1e6, 1e18), _ellipses,
        _image_covariances, everyday=(1e-2, 1e6), tolerance=5e-6, gradients=("covars", "points"),
        gradient_tolerance=2e-3,
    ),
    Function(
        "sample_bilinear", "projection", "pixel number", (0.0, 1e-6, 1.0, 1e3, 1e9, 1e20, 1e30), _image,
        lambda a: sample_bilinear(a["image"].astype(np.float32), a["pixels"].astype(np.float64)),
        everyday=(0.0, 1e30), tolerance=1e-5, numpy=True,
    ),
)  # fmt: skip

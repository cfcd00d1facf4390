"""The body in one row of a pose sequence, float64: arrays in, arrays out, no gradients."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body.canonical import posed_from_canonical
from stages.shared.body.kinematics import posed_vertices
from stages.shared.body.model import BodyModel
from stages.shared.body.poses import Poses

Doubles = NDArray[np.float64]


def posed_body(body: BodyModel, poses: Poses, row: int = 0) -> Doubles:
    """Vertices (V, 3) of the body, world, metres."""
    expression = _double(poses.expression[row])
    with torch.no_grad():
        return posed_vertices(body, *_numbers(poses, row), expression).numpy()


def row_transforms(body: BodyModel, poses: Poses, row: int = 0) -> Doubles:
    """posed_from_canonical (55, 4, 4), with the shape of the poses."""
    with torch.no_grad():
        return posed_from_canonical(body, *_numbers(poses, row)).numpy()


def _numbers(poses: Poses, row: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (55, 3), translation (3,), betas (10,)."""
    return _double(poses.rotations[row]), _double(poses.translation[row]), _double(poses.betas)


def _double(values: NDArray[np.float32]) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)

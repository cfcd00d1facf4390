"""Rows of a pose sequence as tensors, and the body in one of them."""

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


def posed_body(body: BodyModel, poses: Poses) -> Doubles:
    """Vertices (V, 3) of the body in the first frame of a pose sequence, world, metres."""
    expression = torch.as_tensor(poses.expression[0], dtype=torch.float64)
    with torch.no_grad():
        return posed_vertices(body, *pose_tensors(poses, 0, dtype=torch.float64), expression).numpy()


def row_transforms(body: BodyModel, poses: Poses, row: int = 0) -> Doubles:
    """posed_from_canonical (55, 4, 4), with the shape of the poses."""
    with torch.no_grad():
        return posed_from_canonical(body, *pose_tensors(poses, row, dtype=torch.float64)).numpy()


def pose_tensors(
    poses: Poses,
    rows: int | slice | list[int],
    betas: NDArray[np.float32] | None = None,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations (55, 3) rad, translation (3,) m and betas (10,) of one row; several rows give a leading axis.

    Arguments:
        betas: shape to use instead of the shape of the poses.
    """
    arrays = (poses.rotations[rows], poses.translation[rows], poses.betas if betas is None else betas)
    rotations, translation, shape = (torch.as_tensor(array, dtype=dtype) for array in arrays)
    return rotations, translation, shape

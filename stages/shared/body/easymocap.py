"""Poses as EasyMocap writes them: `poses`, `Rh`, `Th`, `shapes`, `expression`, stacked over frames.

The 87 numbers of `poses` are 22 x 3 body angles whose first three are zero (the root's turn is `Rh`), 6 + 6
hand coefficients around a flat hand, and jaw, left and right eye; so its author says. Files whose first three
numbers are not zero have been seen as 63 body angles and 12 + 12 hand coefficients around the mean hand.
`Rh` and `Th` turn and move the body about the world's origin, not about the pelvis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.shared.body.model import BodyModel
from stages.shared.body.npz import NumericNpz
from stages.shared.body.poses import DEFAULT_FPS, Poses, positive_fps
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

_VALUES = 87
_FEW, _MANY = 6, 12  # hand coefficients of the two layouts


def is_easymocap(names: frozenset[str]) -> bool:
    """Whether the arrays of an `.npz` are those of EasyMocap."""
    return {"poses", "Rh", "Th"} <= names


def read_easymocap(file: NumericNpz, body: BodyModel | None) -> Poses:
    """Poses out of an open `.npz`: poses (T, 87), Rh, Th (T, 3), shapes (1 or T, 10), optional expression.

    Raises:
        BadData: other column counts, no body model (its pelvis says what `Th` means), moving hands and a body
            model without a hand space.
    """
    if body is None:
        raise BadData(
            "EasyMocap's translation needs the body model that was fitted.",
            str(file.path),
            "Give it with --body-model.",
        )
    values = _rows(file, "poses", _VALUES)
    turns, moves = _rows(file, "Rh", 3, len(values)), _rows(file, "Th", 3, len(values))
    shapes = _rows(file, "shapes", None) if "shapes" in file else np.zeros((1, SHAPE_COUNT))
    betas = np.zeros(SHAPE_COUNT)
    betas[: min(SHAPE_COUNT, shapes.shape[1])] = shapes[0, :SHAPE_COUNT]
    rotations = np.zeros((len(values), JOINT_COUNT, 3))
    with_root = not values[:, :3].any()
    first, count = (3, _FEW) if with_root else (0, _MANY)
    rotations[:, BODY] = values[:, first : first + 63].reshape(-1, 21, 3)
    hands = values[:, first + 63 : first + 63 + 2 * count]
    rotations[:, LEFT_HAND] = _hand(file, body, "left", hands[:, :count], with_root)
    rotations[:, RIGHT_HAND] = _hand(file, body, "right", hands[:, count:], with_root)
    if with_root:
        for place, joint in enumerate((JAW, LEFT_EYE, RIGHT_EYE)):
            rotations[:, joint] = values[:, 78 + 3 * place : 81 + 3 * place]
    rotations[:, 0] = turns
    pelvis = body.joint_template[0] + body.joint_directions[0] @ betas
    translation = moves + Rotation.from_rotvec(turns).apply(pelvis) - pelvis
    expression = np.zeros((len(values), EXPRESSION_COUNT))
    if "expression" in file:
        given = _rows(file, "expression", None, len(values))[:, :EXPRESSION_COUNT]
        expression[:, : given.shape[1]] = given
    fps = positive_fps(file.array("fps"), file) if "fps" in file else DEFAULT_FPS
    return Poses(
        rotations.astype(np.float32),
        translation.astype(np.float32),
        betas.astype(np.float32),
        expression.astype(np.float32),
        fps,
    )


def _hand(
    file: NumericNpz, body: BodyModel, side: str, coefficients: NDArray[np.float64], flat: bool
) -> NDArray[np.float64]:
    """(T, 15, 3) axis-angle of one hand."""
    components = getattr(body, f"hand_components_{side}")
    mean = getattr(body, f"hand_mean_{side}")
    if flat and not coefficients.any():
        return np.zeros((len(coefficients), 15, 3))
    if components is None or len(components) < coefficients.shape[1] or (not flat and mean is None):
        raise BadData(
            f"The {side} hand is {coefficients.shape[1]} coefficients, and the body model has no hand space.",
            f"{file.path}: poses",
            "Give the body model of the fit (--body-model).",
        )
    values = coefficients @ components[: coefficients.shape[1]].astype(np.float64)
    return np.asarray(values if flat else values + mean, np.float64).reshape(-1, 15, 3)


def _rows(file: NumericNpz, name: str, columns: int | None, frames: int | None = None) -> NDArray[np.float64]:
    """An array as (T, columns)."""
    values = file.array(name)
    if values.dtype.kind not in "fiu":
        raise BadData(f"{name} is not numeric.", f"{file.path}: {name}", "Store plain numbers.")
    rows = np.atleast_2d(values.astype(np.float64))
    rows = rows.reshape(len(rows), -1)
    if not len(rows) or (columns is not None and rows.shape[1] != columns):
        raise BadData(
            f"{name} has shape {values.shape}; expected one row of {columns} values per frame.",
            f"{file.path}: {name}",
            "Stack the frames' parameters: poses (T, 87), Rh (T, 3), Th (T, 3), shapes (1, 10).",
        )
    if frames is not None and len(rows) not in (1, frames):
        raise BadData(
            f"{name} has {len(rows)} rows, poses has {frames}.",
            f"{file.path}: {name}",
            "Give one row, or as many as there are frames.",
        )
    return rows if frames is None else np.broadcast_to(rows, (frames, rows.shape[1])).copy()

"""The compact form in which the body model comes inside the package.

Positions and shape directions are stored as scaled 16-bit integers per axis (and per direction), the few
largest skin weights of every vertex as 16-bit fractions, the joint regressor as a sparse list. Unpacking is
plain arithmetic, the same on every machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from stages.shared.body.model import BodyModel
from stages.shared.body.skeleton import JOINT_COUNT
from stages.shared.errors import BadData, MissingInput
from stages.shared.finite import require_finite

_LEVELS = 32767
_WEIGHT_LEVELS = 65535


def pack_body(body: BodyModel, weights_per_vertex: int = 6) -> dict[str, NDArray[Any]]:
    """The arrays of the compact file; `unpack_arrays` undoes it up to rounding.

    Arguments:
        body: a model without expression, pose correctives and hand space.
        weights_per_vertex: largest skin weights stored per vertex.

    Returns:
        vertices (V,3) i16 with vertex_scale (3,) f32 metres per step; shape (V,3,10) i16 with shape_scale
        (3,10) f32; faces (F,3) u16; weight_joints (V,K) u8, weights (V,K) u16; regressor_joints (R,) u8,
        regressor_vertices (R,) u16, regressor_values (R,) f32.
    """
    require_finite(
        "pack_body", template_vertices=body.template_vertices, shape_directions=body.shape_directions
    )
    vertices, vertex_scale = _quantise(body.template_vertices)
    shape, shape_scale = _quantise(body.shape_directions)
    joints = np.argsort(-body.skin_weights, axis=1, kind="stable")[:, :weights_per_vertex]
    largest = np.take_along_axis(body.skin_weights, joints, axis=1)
    largest = np.round(largest / largest.sum(axis=1, keepdims=True) * _WEIGHT_LEVELS)
    rows, columns = np.nonzero(body.joint_regressor)
    return {
        "vertices": vertices,
        "vertex_scale": vertex_scale,
        "shape": shape,
        "shape_scale": shape_scale,
        "faces": body.faces.astype(np.uint16),
        "weight_joints": joints.astype(np.uint8),
        "weights": largest.astype(np.uint16),
        "regressor_joints": rows.astype(np.uint8),
        "regressor_vertices": columns.astype(np.uint16),
        "regressor_values": body.joint_regressor[rows, columns].astype(np.float32),
    }


def unpack_arrays(packed: dict[str, NDArray[Any]], source: str) -> BodyModel:
    """The body model out of the arrays of `pack_body`. Raises BadData when they do not fit together."""
    count = len(packed["vertices"])
    weights = np.zeros((count, JOINT_COUNT), dtype=np.float32)
    largest = packed["weights"].astype(np.float32)
    rows = np.repeat(np.arange(count), largest.shape[1])
    np.add.at(weights, (rows, packed["weight_joints"].reshape(-1)), largest.reshape(-1))
    regressor = np.zeros((JOINT_COUNT, count), dtype=np.float32)
    regressor[packed["regressor_joints"], packed["regressor_vertices"]] = packed["regressor_values"]
    return BodyModel.from_arrays(
        {
            "template_vertices": packed["vertices"] * packed["vertex_scale"],
            "faces": packed["faces"],
            "shape_directions": packed["shape"] * packed["shape_scale"],
            "skin_weights": weights / weights.sum(axis=1, keepdims=True),
            "joint_regressor": regressor,
        },
        source=source,
    )


def unpack_body(path: Path) -> BodyModel:
    """Read the compact file at `path`. Raises MissingInput or BadData."""
    if not path.is_file():
        raise MissingInput("The body model of the package is not installed.", str(path), "Install gw again.")
    try:
        return unpack_arrays(load_file(path), "the embedded body")
    except (SafetensorError, KeyError, IndexError, ValueError) as error:
        raise BadData(
            f"The body model of the package is damaged: {error}.", str(path), "Install gw again."
        ) from error


def _quantise(values: NDArray[np.float32]) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
    """16-bit steps and the size of a step for each position behind the first axis."""
    scale = (np.abs(values).max(axis=0) / _LEVELS).astype(np.float32)
    return np.round(values / scale).astype(np.int16), scale

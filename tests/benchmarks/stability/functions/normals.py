"""Normals of meshes and of map texels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from stages.shared.avatar.deform import estimate_normals
from stages.shared.meshes.topology import face_normals, vertex_normals
from tests.benchmarks.stability.function import Function, Inputs
from tests.benchmarks.stability.functions.sheet import SIDE, sheet

_EDGES = (1e-150, 1e-30, 1e-18, 1e-9, 1e-3, 1.0, 1e6, 1e18, 1e30)
_FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32)


def _tetrahedron(edge: float, random: np.random.Generator) -> Inputs:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return {"vertices": edge * (corners + 0.1 * random.random((4, 3)))}


def _hills(pitch: float, random: np.random.Generator) -> Inputs:
    rows, columns = np.divmod(np.arange(SIDE * SIDE), SIDE)
    heights = 0.5 * random.random(len(rows))
    points = np.stack([columns, -rows, heights], axis=1).astype(float)
    return {"means": pitch * points, "fallback": np.tile([0.0, 0.0, 1.0], (len(rows), 1))}


def _texel_normals(a: dict[str, Any]) -> torch.Tensor:
    return estimate_normals(a["means"], sheet(), a["fallback"])


NORMALS = (
    Function(
        "face_normals", "normals", "edge length, m", _EDGES, _tetrahedron,
        lambda a: face_normals(a["vertices"], _FACES)[0], everyday=(1e-30, 1e30), numpy=True,
    ),
    Function(
        "vertex_normals", "normals", "edge length, m", _EDGES, _tetrahedron,
        lambda a: vertex_normals(a["vertices"], _FACES), everyday=(1e-9, 1e6), numpy=True,
    ),
    Function(
        "estimate_normals", "normals", "pitch of the texels, m",
        (1e-30, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e18, 1e30), _hills,
        _texel_normals, everyday=(1e-3, 1e3), tolerance=5e-6, bfloat16=True,
    ),
)  # fmt: skip

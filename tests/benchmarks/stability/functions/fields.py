"""Trilinear samples of voxel fields, and values spread from a surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from stages.shared.fields.diffusion import inverse_distance_matrix
from stages.shared.fields.voxel_field import VoxelField
from tests.benchmarks.stability.function import Function, Inputs, unit

_SURFACE = unit(np.random.default_rng(0), 60)


def _sampled(metres: float, random: np.random.Generator) -> Inputs:
    return {"points": metres * unit(random, 50), "values": random.random((4, 5, 6, 7))}


def _sample(a: dict[str, Any]) -> np.ndarray:
    values = a["values"]
    everywhere = np.ones(values.shape[1:], bool)
    field = VoxelField.from_band(values.reshape(len(values), -1).T, everywhere, np.zeros(3), np.ones(3))
    return field.sample(a["points"])


def _cloud(metres: float, random: np.random.Generator) -> Inputs:
    return {"points": metres * unit(random, 50)}


def _spread(a: dict[str, Any]) -> np.ndarray:
    matrix, _, _ = inverse_distance_matrix(cKDTree(_SURFACE), a["points"].astype(np.float64), 8)
    return np.asarray(matrix @ _SURFACE)


FIELDS = (
    Function(
        "VoxelField.sample", "voxel sampling", "distance of the points, m; the box is 1 m",
        (0.0, 1e-30, 1e-6, 0.5, 1.0, 1e3, 1e20, 1e30), _sampled, _sample,
        everyday=(0.0, 1e30), tolerance=1e-5, numpy=True,
    ),
    Function(
        "inverse_distance_matrix", "voxel sampling", "distance of the points, m; the surface is at 1 m",
        (0.0, 1e-30, 0.5, 1.0, 1e3, 1e9, 1e30), _cloud, _spread,
        everyday=(0.0, 1e3), tolerance=1e-4, numpy=True,
    ),
)  # fmt: skip

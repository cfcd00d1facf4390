"""A small layer for functions that need one: a flat sheet of texels that faces the front."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import torch

from stages.shared.avatar.maps import LayerMaps
from tests.benchmarks.stability.function import weights

SIDE = 6
PITCH = 0.05


@cache
def sheet(dtype: torch.dtype = torch.float32) -> LayerMaps:
    """6 × 6 texels 5 cm apart, each on four bones, whose shape changes by centimetres per unit."""
    random = np.random.default_rng(0)
    rows, columns = np.divmod(np.arange(SIDE * SIDE), SIDE)
    count = len(rows)
    number = np.pad(np.arange(count).reshape(SIDE, SIDE), 1, constant_values=-1)
    steps = ((-1, 0), (0, 1), (1, 0), (0, -1))
    middle = (SIDE - 1) / 2
    arrays = {
        "texels": np.stack([0 * rows, rows, columns], axis=1),
        "window": np.array([0, 0, SIDE, SIDE]),
        "positions": PITCH * np.stack([columns - middle, middle - rows, 0.0 * rows], axis=1),
        "normals": np.tile([0.0, 0.0, 1.0], (count, 1)),
        "skin_weights": weights(random, count),
        "shape_directions": 0.01 * random.normal(size=(count, 10, 3)),
        "neighbours": np.stack([number[rows + 1 + r, columns + 1 + c] for r, c in steps], axis=1),
        "seams": np.zeros((0, 2), int),
        "spacing": np.full(count, 0.6 * PITCH),
        "colors": random.random((count, 3)),
        "color_confidence": np.ones(count),
    }
    maps = LayerMaps.from_arrays("body", arrays, PITCH, (0.0, 0.0, 0.0), SIDE)
    tensors = {field.name: getattr(maps, field.name) for field in fields(maps)}
    typed = {
        name: value.to(dtype)
        for name, value in tensors.items()
        if isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    return replace(maps, **typed)  # type: ignore[arg-type]

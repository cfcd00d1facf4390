"""Sparse linear systems over the cells of a layer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.train.cells import Cells

Floats = NDArray[np.float64]
_FIT_STEPS = 60
_FIT_STRETCH = 1e-4  # cells that hardly any texel follows go with their neighbours


def conjugate_gradients(applied: Any, right: Floats, steps: int) -> Floats:
    """Solve A x = right (M, 3) for a symmetric positive A given as a function, from zero."""
    found = np.zeros_like(right)
    rest, along = right.copy(), right.copy()
    size = first = float((rest * rest).sum())
    for _ in range(steps):
        if size <= 1e-10 * first or size == 0.0:
            break
        image = applied(along)
        length = size / float((along * image).sum())
        found += length * along
        rest -= length * image
        smaller = float((rest * rest).sum())
        along = rest + smaller / size * along
        size = smaller
    return found


def fitted_cells(cells: Cells, values: Floats) -> Floats:
    """Cells (M, 3) whose interpolation comes nearest to values (N, 3) of the texels."""

    def applied(x: Floats) -> Floats:
        return np.asarray(cells.basis.T @ (cells.basis @ x) + _FIT_STRETCH * (cells.stretch @ x))

    return conjugate_gradients(applied, np.asarray(cells.basis.T @ values), _FIT_STEPS)

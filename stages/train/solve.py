"""Sparse linear systems over the cells of a layer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.shared.finite import finite, require_finite
from stages.train.cells import Cells

Floats = NDArray[np.float64]
_FIT_STEPS = 60
_NOTHING = 1e-13  # of the stiffest direction met: rounding, not resistance
_FIT_STRETCH = 1e-4  # cells that hardly any texel follows go with their neighbours


def conjugate_gradients(applied: Any, right: Floats, steps: int) -> Floats:
    """Solve A x = right (M, 3) for a symmetric A ≥ 0 given as a function, from zero.

    Directions about which A says nothing are left at zero.

    Raises:
        BadData: the right side, or what A makes of it, is not finite.
    """
    require_finite("conjugate_gradients", right=right)
    # A power of two, so that no bit changes: squares of tiny or huge numbers are none.
    scale = 2.0 ** np.floor(np.log2(np.abs(right).max(initial=0.0) or 1.0))
    found = np.zeros_like(right)
    rest = right / scale
    along, stiffest = rest.copy(), 0.0
    size = first = float((rest * rest).sum())
    for _ in range(steps):
        if size <= 1e-10 * first or size == 0.0:
            break
        image = finite(applied(along), "conjugate_gradients")
        curve = float((along * image).sum())
        softness = curve / float((along * along).sum())
        stiffest = max(stiffest, softness)
        if softness <= _NOTHING * stiffest:
            break
        length = size / curve
        found += length * along
        rest -= length * image
        smaller = float((rest * rest).sum())
        along = rest + smaller / size * along
        size = smaller
    return found * scale


def fitted_cells(cells: Cells, values: Floats) -> Floats:
    """Cells (M, 3) whose interpolation comes nearest to values (N, 3) of the texels."""

    def applied(x: Floats) -> Floats:
        return np.asarray(cells.basis.T @ (cells.basis @ x) + _FIT_STRETCH * (cells.stretch @ x))

    return conjugate_gradients(applied, np.asarray(cells.basis.T @ values), _FIT_STEPS)

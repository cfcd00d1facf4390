"""The control grid of a layer: cells of its key-pose maps as the unknowns of tracking.

Texels follow the cells around them, bilinearly. Smoothness connects cells whose texels touch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.finite import finite, require_finite

Floats = NDArray[np.float64]
_FIT_STEPS = 60
_NULL = 1e-13  # of the largest curvature so far: rounding
_FIT_STRETCH = 1e-4  # cells that hardly any texel follows move with their neighbours


@dataclass(frozen=True, eq=False)
class ControlGrid:
    """ControlGrid that some texel follows.

    Attributes:
        where: (M,) int64 index of each cell into a flattened key-pose map (2, h, w).
        basis: (N, M) sparse, rows sum to 1: texel values from cell values, bilinear.
        bending: (M, M) sparse, xᵀ B x = Σ ‖x − mean of the neighbours‖². stretch: (M, M) sparse,
            xᵀ S x = Σ over pairs of neighbours ‖x_a − x_b‖².
    """

    where: NDArray[np.int64]
    basis: sparse.csr_matrix
    bending: sparse.csr_matrix
    stretch: sparse.csr_matrix

    @classmethod
    def of(cls, maps: LayerMaps, points: Tensor, size: tuple[int, int]) -> ControlGrid:
        """The grid of maps of `size` (height, width) per side. Texels sample it at `points` (N, 2), −1..1."""
        height, width = size
        at = (points.double().cpu().numpy() + 1) / 2 * [width, height] - 0.5
        at = np.clip(at, 0, [width - 1, height - 1])
        low = np.minimum(np.floor(at).astype(np.int64), [max(width - 2, 0), max(height - 2, 0)])
        part = at - low
        side = (maps.texels[:, 0] % 2).cpu().numpy()
        columns, shares = [], []
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            x, y = np.minimum(low[:, 0] + right, width - 1), np.minimum(low[:, 1] + down, height - 1)
            columns.append((side * height + y) * width + x)
            shares.append(
                (part[:, 0] if right else 1 - part[:, 0]) * (part[:, 1] if down else 1 - part[:, 1])
            )
        rows = np.tile(np.arange(len(maps)), 4)
        full = sparse.csr_matrix(
            (np.concatenate(shares), (rows, np.concatenate(columns))), shape=(len(maps), 2 * height * width)
        )
        where = np.unique(full.indices[full.data > 1e-9]).astype(np.int64)
        basis = full[:, where].tocsr()
        bending, stretch = _smoothness(_adjacent_cells(maps, basis))
        return cls(where, basis, bending, stretch)


def _adjacent_cells(maps: LayerMaps, basis: sparse.csr_matrix) -> sparse.csr_matrix:
    """(M, M) 0 or 1: cells that share a texel, a link between neighbouring texels, or a seam."""
    first, second = maps.links()
    links = sparse.csr_matrix((np.ones(len(first)), (first, second)), shape=(len(maps), len(maps)))
    texels = sparse.identity(len(maps), format="csr") + links
    pattern = (basis > 0.05).astype(np.float64)
    shared = (pattern.T @ texels @ pattern).tocsr()
    shared = (shared + shared.T).tocsr()
    shared.setdiag(0)
    shared.eliminate_zeros()
    return (shared > 0).astype(np.float64)


def _smoothness(adjacent: sparse.csr_matrix) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """The two quadratic forms of `ControlGrid`, from the adjacency of its cells."""
    number = np.asarray(adjacent.sum(axis=1)).ravel()
    means = sparse.diags(1.0 / np.maximum(number, 1.0)) @ adjacent
    away = sparse.diags((number > 0).astype(np.float64)) - means
    return (away.T @ away).tocsr(), (sparse.diags(number) - adjacent).tocsr()


def conjugate_gradient(apply: Callable[[Floats], Floats], right: Floats, steps: int) -> Floats:
    """Solve A x = right (M, 3) for a symmetric A ≥ 0 that is given as a function. Starts at zero.

    Directions in the null space of A stay at zero.

    Raises:
        BadData: the right side, or A times a vector, is not finite.
    """
    require_finite("conjugate_gradient", right=right)
    # A power of two, so that no bit changes; it keeps squares of tiny or huge numbers finite.
    scale = 2.0 ** np.floor(np.log2(np.abs(right).max(initial=0.0) or 1.0))
    solution = np.zeros_like(right)
    rest = right / scale
    along, stiffest = rest.copy(), 0.0
    size = first = float((rest * rest).sum())
    for _ in range(steps):
        if size <= 1e-10 * first or size == 0.0:
            break
        image = finite(apply(along), "conjugate_gradient")
        curve = float((along * image).sum())
        softness = curve / float((along * along).sum())
        stiffest = max(stiffest, softness)
        if softness <= _NULL * stiffest:
            break
        length = size / curve
        solution += length * along
        rest -= length * image
        smaller = float((rest * rest).sum())
        along = rest + smaller / size * along
        size = smaller
    return solution * scale


def fit_control_points(cells: ControlGrid, values: Floats) -> Floats:
    """Cell values (M, 3) whose interpolation is nearest to values (N, 3) of the texels."""

    def apply(x: Floats) -> Floats:
        return np.asarray(cells.basis.T @ (cells.basis @ x) + _FIT_STRETCH * (cells.stretch @ x))

    return conjugate_gradient(apply, np.asarray(cells.basis.T @ values), _FIT_STEPS)

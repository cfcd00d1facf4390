"""The cells of a layer's anchor maps as unknowns: how texels follow them, and how they hang together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells that some texel follows.

    Attributes:
        where: (M,) int64 index of each cell into a flattened anchor map (2, h, w).
        basis: (N, M) sparse, rows sum to 1: texel values from cell values, bilinear.
        bending: (M, M) sparse, xᵀ B x = Σ ‖x − mean of the neighbours‖². stretch: (M, M) sparse,
            xᵀ S x = Σ over pairs of neighbours ‖x_a − x_b‖².
    """

    where: NDArray[np.int64]
    basis: sparse.csr_matrix
    bending: sparse.csr_matrix
    stretch: sparse.csr_matrix

    @classmethod
    def of(cls, maps: LayerMaps, points: Tensor, size: tuple[int, int]) -> Cells:
        """Cells of maps (height, width) = `size` per side that texels at `points` (N, 2), −1..1, sample."""
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
        bending, stretch = _smoothness(_beside(maps, basis))
        return cls(where, basis, bending, stretch)


def _beside(maps: LayerMaps, basis: sparse.csr_matrix) -> sparse.csr_matrix:
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


def _smoothness(beside: sparse.csr_matrix) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """The two quadratic forms of `Cells` from which cells are beside which."""
    number = np.asarray(beside.sum(axis=1)).ravel()
    means = sparse.diags(1.0 / np.maximum(number, 1.0)) @ beside
    away = sparse.diags((number > 0).astype(np.float64)) - means
    return (away.T @ away).tocsr(), (sparse.diags(number) - beside).tocsr()

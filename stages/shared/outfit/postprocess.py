"""Turns blended features into colours, depth and labels, in one compiled pass over the pixels."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.shared.layers import NO_LABEL

# mypy: ignore-errors
# (compiled and type-checked by numba)

_LABEL_ALPHA = np.float32(0.5)  # thinner than this counts as background, for labels as for silhouettes


@njit(nogil=True, cache=True, error_model="numpy")
def postprocess(features, alpha, summed_depth, ids, color, depth, labels):
    """Colour, depth and labels of a rendering.

    Arguments:
        features: (H, W, 3 + L) colours and one-hot labels, blended. alpha, summed_depth: (H, W).
        ids: (L,) u8 label id of every layer.
        color: (H, W, 3) is set to the colours, clipped to 0..1.
        depth: (H, W) is set to the mean depth in metres, 0 where nothing is.
        labels: (H, W) u8 is set to the id of the layer with the largest share (the first of equals).
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            covered = alpha[row, column]
            for c in range(3):
                color[row, column, c] = min(max(features[row, column, c], zero), one)
            depth[row, column] = summed_depth[row, column] / covered if covered > zero else zero
            best = NO_LABEL
            if covered >= _LABEL_ALPHA:
                winner, most = 0, features[row, column, 3]
                for layer in range(1, len(ids)):
                    if features[row, column, 3 + layer] > most:
                        winner, most = layer, features[row, column, 3 + layer]
                best = ids[winner]
            labels[row, column] = best

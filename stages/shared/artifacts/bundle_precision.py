"""Which tensors of a bundle are stored with 16 bits: those where the loss is not visible.

Positions, spacings, indices and the body model keep 32 bits.
`tests/benchmarks/precision.py` measures the rest.
"""

from __future__ import annotations

import numpy as np

from stages.shared.artifacts.arrays import Arrays
from stages.shared.texel_maps import ARRAYS

PRECISIONS = ("float16", "float32")
HALF = (
    *(f"maps/{name}" for name, array in ARRAYS.items() if array.half),
    "swap/offsets",
    "swap/quaternions",
    "skin/covered",
    "skin/offsets",
    "skin/colors",
)
_LARGEST = 6e4  # float16 ends at 65504
_SMALLEST = 1e-4  # below 6e-5 float16 loses digits


def may_be_half(name: str) -> bool:
    """Whether a tensor of this name may have 16 bits."""
    return name in HALF or name.startswith("model/")


def halved(arrays: Arrays) -> Arrays:
    """The arrays with 16 bits where that is allowed, and where the values are such that it is harmless."""
    return {name: _half(array) if may_be_half(name) else array for name, array in arrays.items()}


def whole(arrays: Arrays) -> Arrays:
    """The arrays with 32 bits, and skinning weights whose rows sum to one again."""
    widened = {
        name: array.astype(np.float32) if array.dtype == np.float16 else array
        for name, array in arrays.items()
    }
    for name in ("maps/skin_weights", "skin_weights"):
        if name in arrays and arrays[name].dtype == np.float16:
            widened[name] /= widened[name].sum(axis=1, keepdims=True)
    return widened


def _half(array: np.ndarray) -> np.ndarray:
    if array.dtype != np.float32 or array.size == 0:
        return array
    largest = np.abs(array).max()
    # A tensor all of whose values are tiny (a scale, say) would lose its digits. NaN is left as it is, for
    # the writer to refuse.
    return array.astype(np.float16) if largest == 0 or _SMALLEST <= largest <= _LARGEST else array

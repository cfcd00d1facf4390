"""Peak signal-to-noise ratio of 8-bit pictures."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.shared.errors import BadData

Picture = NDArray[np.uint8]
PEAK = 255.0


def psnr(prediction: Picture, truth: Picture, inside: NDArray[np.bool_] | None = None) -> float | None:
    """PSNR in dB: 10 log10(255² / mean squared difference of the sRGB values).

    Arguments:
        prediction, truth: (H, W, 3) u8.
        inside: (H, W) pixels that count; None for all.

    Returns:
        dB; infinity for equal pictures, None where no pixel counts.

    Raises:
        BadData: shapes or types that do not agree.
    """
    check_pictures(prediction, truth)
    difference = prediction.astype(np.int32) - truth.astype(np.int32)
    if inside is not None:
        difference = difference[inside]
    if not difference.size:
        return None
    error = float(np.mean(np.square(difference), dtype=np.float64))
    return math.inf if error == 0 else 10 * math.log10(PEAK**2 / error)


def check_pictures(prediction: Picture, truth: Picture) -> None:
    """Raise BadData unless both are 8-bit colour pictures of one size."""
    for name, picture in (("prediction", prediction), ("truth", truth)):
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise BadData(
                f"The {name} is {picture.dtype} {picture.shape}, not an 8-bit colour picture.",
                name,
                "Give (H, W, 3) u8 sRGB.",
            )
    if prediction.shape != truth.shape:
        raise BadData(
            f"The prediction has {prediction.shape[1]} x {prediction.shape[0]} pixels, the truth "
            f"{truth.shape[1]} x {truth.shape[0]}.",
            "prediction, truth",
            "Render with the cameras of the truth.",
        )

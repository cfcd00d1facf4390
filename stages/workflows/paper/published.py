"""Values printed in the paper that this project follows (Gaussian Wardrobe), for tables beside one's own.

They are of 4D-DRESS and ActorsHQ, of the authors' code on their GPUs. Another data set has other values, so a
row of one's own can be compared with them only on those data sets.
"""

from __future__ import annotations

from dataclasses import dataclass

METHODS = {"animatable-gaussians": "AG", "layga": "LayGA", "gaussian-wardrobe": "GW"}


@dataclass(frozen=True)
class PublishedRow:
    """One row: the data, the method as this project calls it, what was left out, and scores by name."""

    data: str
    method: str
    scores: dict[str, float]
    without: tuple[str, ...] = ()


def _pictures(data: str, **values: tuple[float, float, float]) -> list[PublishedRow]:
    """PSNR, SSIM and LPIPS of the three methods."""
    short = {name: method for method, name in METHODS.items()}
    scores = ("psnr", "ssim", "lpips")
    return [PublishedRow(data, short[n], dict(zip(scores, v, strict=True))) for n, v in values.items()]


def _labels(without: tuple[str, ...], miou: float, recall: float, f1: float) -> PublishedRow:
    return PublishedRow("4D-DRESS", "gaussian-wardrobe", {"miou": miou, "recall": recall, "f1": f1}, without)


NOVEL_POSE = [
    *_pictures(
        "4D-DRESS", AG=(27.75, 0.9577, 0.0531), LayGA=(27.58, 0.9574, 0.0543), GW=(28.06, 0.9579, 0.0527)
    ),
    *_pictures(
        "ActorsHQ", AG=(27.92, 0.9411, 0.0418), LayGA=(27.80, 0.9413, 0.0421), GW=(28.38, 0.9436, 0.0397)
    ),
]
NOVEL_VIEW = _pictures(
    "ActorsHQ", AG=(30.51, 0.9491, 0.0332), LayGA=(30.36, 0.9482, 0.0337), GW=(30.86, 0.9489, 0.0331)
)
ABLATION = [
    _labels(("sg",), 0.848, 0.898, 0.924),
    _labels(("reg",), 0.879, 0.922, 0.940),
    _labels(("pe",), 0.883, 0.927, 0.942),
    _labels((), 0.893, 0.936, 0.947),
]

"""Penetration-aware rendering: where an inner layer pokes through a garment, the pixel shows the garment.

A pixel is penetrated by the inner layer I of an outer layer O when it lies inside the outlines of O (holes
filled, rim eroded), O alone is opaque there, and I is at most ε in front of O. The pixel then takes the
rendering of O alone (Gaussian Wardrobe, sec. 3.5). Layers farther in front, such as an arm in front of a
jacket, are not changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.shared.layers import BODY
from stages.shared.splat.gaussians import Rendering

if TYPE_CHECKING:
    from stages.shared.splat.cpu_layers import LayeredView

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class PenetrationConfig:
    """Tolerances of the test.

    Attributes:
        body_margin: metres that the body may be in front of a garment and still penetrate it.
        garment_margin: metres, the same between garments.
        rim: width in pixels of the zone inside a garment's outline that is not changed.
        opaque: alpha of the garment alone from which it can replace a pixel.
    """

    body_margin: float = 0.03
    garment_margin: float = 0.05
    rim: int = 2
    opaque: float = 0.95

    def margin(self, inner: str) -> float:
        """Metres that a layer may be in front of a garment and still penetrate it."""
        return self.body_margin if inner == BODY else self.garment_margin


# Garments of other people fit less closely: the margins published for try-on.
TRYON_MARGINS = PenetrationConfig(body_margin=0.05, garment_margin=0.10)


@dataclass(frozen=True, eq=False)
class ResolvedImage:
    """A rendering after the pass.

    Attributes:
        rendering: the composite with the penetrated pixels replaced.
        mask: (H, W) pixels that showed an inner layer and now show the garment.
        counts: "inner/outer" to their number, for every pair.
    """

    rendering: Rendering
    mask: Mask
    counts: dict[str, int]


def resolve_penetration(
    rendering: Rendering, layers: tuple[str, ...], config: PenetrationConfig = PenetrationConfig()
) -> ResolvedImage:
    """Run the pass over every pair of layers, garments among each other first, then the body against each.

    Arguments:
        rendering: of one camera, all layers alone; the composite's features are colours (3) and one-hot
            labels (L), those of layers alone begin with colours; on black.
        layers: L names, inner to outer.
    """
    repaired = Rendering(rendering.features.clone(), rendering.alpha.clone(), rendering.depth.clone())
    total = np.zeros(tuple(rendering.alpha.shape), bool)
    box = _box(rendering.alpha.numpy())
    features, alpha, depth = (
        field.numpy()[box] for field in (repaired.features, repaired.alpha, repaired.depth)
    )
    own_color = [alone.features.numpy()[box][..., :3] for alone in rendering.layers]
    own_alpha = [alone.alpha.numpy()[box] for alone in rendering.layers]
    own_sum = [alone.depth.numpy()[box] for alone in rendering.layers]
    own_depth = [_depth(*pair) for pair in zip(own_sum, own_alpha, strict=True)]
    counts = _no_counts(layers)
    for inner, outer in _pairs(layers):
        shown = (features[..., 3 + outer] > 0.5) & (alpha >= 0.5)
        if not shown.any():
            continue
        inside = fill_contours(shown, config.rim)
        opaque = own_alpha[outer] > config.opaque
        behind = own_depth[inner] >= own_depth[outer] - config.margin(layers[inner])
        place = np.nonzero(inside & opaque & behind)
        winner = features[place][:, 3:].argmax(axis=1)
        among = (winner == inner) | (winner == outer)  # a third layer in front stays
        place, wrong = tuple(axis[among] for axis in place), winner[among] == inner
        counts[f"{layers[inner]}/{layers[outer]}"] = int(wrong.sum())
        total[box][tuple(axis[wrong] for axis in place)] = True
        taken = np.zeros((len(wrong), features.shape[2]), np.float32)
        taken[:, :3], taken[:, 3 + outer] = own_color[outer][place], own_alpha[outer][place]
        features[place], alpha[place], depth[place] = taken, own_alpha[outer][place], own_sum[outer][place]
    return ResolvedImage(repaired, total, counts)


def resolve_penetration_tiles(
    view: LayeredView, layers: tuple[str, ...], config: PenetrationConfig = PenetrationConfig()
) -> ResolvedImage:
    """`resolve_penetration` on the tile lists of a rendering, changed in place: the same bytes, faster.

    A layer is rendered alone only in those blocks of tiles in which a pixel depends on it.
    """
    picture, box = view.rendering, view.box()
    inside, repaired = (np.zeros(tuple(picture.alpha.shape), np.uint8) for _ in range(2))
    counts = _no_counts(layers)
    for inner, outer in _pairs(layers):
        shown = view.shown(outer, box)
        if shown.any():
            inside[box], margin = fill_contours(shown, config.rim), config.margin(layers[inner])
            number = view.resolve_pair(inside, inner, outer, margin, config.opaque, repaired)
            counts[f"{layers[inner]}/{layers[outer]}"] = number
    return ResolvedImage(picture, repaired.view(bool), counts)


def fill_contours(shown: Mask | NDArray[np.uint8], rim: int) -> Mask:
    """The pixels inside the outer contours of a mask (H, W), holes filled, eroded by `rim` pixels."""
    picture = np.ascontiguousarray(shown, dtype=np.uint8)
    contours, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros_like(picture), contours, -1, 1, cv2.FILLED)
    if rim > 0:
        filled = cv2.erode(filled, np.ones((3, 3), np.uint8), iterations=rim, borderValue=0)
    return np.asarray(filled, dtype=bool)


def _pairs(layers: tuple[str, ...]) -> list[tuple[int, int]]:
    """(inner, outer) indices in the order of the pass."""
    garments = [index for index, name in enumerate(layers) if name != BODY]
    pairs = [(inner, outer) for outer in garments for inner in garments if inner < outer]
    return pairs + [(layers.index(BODY), outer) for outer in garments if BODY in layers]


def _no_counts(layers: tuple[str, ...]) -> dict[str, int]:
    return {f"{layers[inner]}/{layers[outer]}": 0 for inner, outer in _pairs(layers)}


def _box(alpha: Floats) -> tuple[slice, slice]:
    """Rows and columns of a picture (H, W) with something in them."""
    rows, columns = (np.flatnonzero((alpha > 0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _depth(depth: Floats, alpha: Floats) -> Floats:
    """(H, W) mean depth in metres from the sum over Gaussians; infinity where there is nothing."""
    far = np.full(alpha.shape, np.inf, np.float32)
    return np.asarray(np.divide(depth, alpha, out=far, where=alpha > 1e-4))

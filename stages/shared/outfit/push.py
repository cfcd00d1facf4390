"""Push-out: a garment of another person moves out of the wearer's body where that is larger.

A garment takes the wearer's shape through the shape directions, but what it was learned on is its source's
body: with other muscles, other underwear, other learned offsets. Once per outfit, in the re-shaped canonical
pose, every texel that is closer than `CLEARANCE` to the layers beneath it asks for a displacement along their
normal; the smooth field that meets all of them is added to the garment's offsets in every pose. Pieces that
were learned together keep the distance that they learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from stages.shared.avatar.deform import pose_layer
from stages.shared.avatar.maps import LayerMaps
from stages.shared.outfit.layer import WornLayer

CLEARANCE = 0.004  # m between a garment's Gaussians and what is beneath
_DEEPEST = 0.06  # m; farther inside is not poking through but the other side of the body
_DEEPEST_GARMENT = 0.015  # m; between garments: deeper, they hang beside each other
_NEAREST = 4  # points beneath that are averaged
_ITERATIONS = 80  # of smoothing; the field reaches about √80 texels beyond the places that ask
_FADING = 0.98  # per iteration, so that a push far away dies out

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Push:
    """Displacement of one garment.

    Attributes:
        garment: layer name.
        displacement: (N, 3) m, canonical, added to the offsets.
        inside_before, inside_after: share of the texels that are closer than the clearance.
    """

    garment: str
    displacement: Tensor
    inside_before: float
    inside_after: float

    @property
    def count(self) -> int:
        """Texels that move by more than a tenth of a millimetre."""
        return int((self.displacement.norm(dim=1) > 1e-4).sum())


@dataclass(frozen=True, eq=False)
class _Form:
    """A layer in the re-shaped canonical pose: points and normals (M, 3), and who it was learned with."""

    layer: str
    points: Floats
    normals: Floats
    source: str
    tree: cKDTree


@torch.no_grad()
def plan_pushes(layers: Sequence[WornLayer], betas: Tensor, clearance: float = CLEARANCE) -> tuple[Push, ...]:
    """The displacement of every garment that touches what is beneath it, inner garments first.

    Arguments:
        layers: inner to outer, body first. betas: (10,) of the wearer.
    """
    before: list[_Form] = []  # as learned: what pieces of one source are to each other
    beneath: list[_Form] = []
    pushes = []
    for layer in layers:
        form = _form(layer, betas)
        if layer.name != "body":
            push = _push(layer, form, beneath, before, clearance)
            if push is not None:
                pushes.append(push)
                moved = form.points + push.displacement.numpy()
                beneath.append(_Form(form.layer, moved, form.normals, form.source, cKDTree(moved)))
                before.append(form)
                continue
        beneath.append(form)
        before.append(form)
    return tuple(pushes)


def _form(layer: WornLayer, betas: Tensor) -> _Form:
    """Points and normals of the two outer sheets: front and back."""
    still = torch.eye(4).expand(55, 4, 4)
    posed = pose_layer(layer.maps, layer.model(still), still, betas)
    points = posed.means.numpy()
    return _Form(layer.name, points, posed.normals.numpy(), layer.source, cKDTree(points))


def _push(
    layer: WornLayer, form: _Form, beneath: list[_Form], before: list[_Form], clearance: float
) -> Push | None:
    """The push of one garment against all that lies beneath; None where it touches nothing."""
    needs, normals = [], []
    for inner, learned in zip(beneath, before, strict=True):
        height, normal = _height(form, inner)
        wanted = np.full(len(height), clearance, np.float32)
        if form.source and form.source == learned.source:
            wanted = np.minimum(wanted, _height(form, learned)[0])
        need = np.clip(wanted - height, 0, None)
        deepest = _DEEPEST if inner.layer == "body" else _DEEPEST_GARMENT
        needs.append(np.where(height < -deepest, 0, need))
        normals.append(normal)
    need, normal = np.stack(needs), np.stack(normals)
    most = need.argmax(axis=0)
    rows = np.arange(need.shape[1])
    need, normal = need[most, rows], normal[most, rows]
    if not (need > 1e-4).any():
        return None
    field = smooth_field(layer.maps, need, normal)
    left = need - np.einsum("nk,nk->n", field, normal)
    return Push(layer.name, torch.from_numpy(field), float((need > 1e-4).mean()), float((left > 1e-3).mean()))


def _height(form: _Form, inner: _Form) -> tuple[Floats, Floats]:
    """Height (N,) m of a garment's points over an inner layer, and that layer's normal (N, 3) there.

    Infinite where the inner layer is farther than a hand's breadth: there is nothing beneath.
    """
    distance, nearest = inner.tree.query(form.points, k=_NEAREST)
    weights = 1 / np.maximum(distance, 1e-3)[..., None]
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    normal = (inner.normals[nearest] * weights).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    base = (inner.points[nearest] * weights).sum(axis=1)
    height = np.einsum("nk,nk->n", form.points - base, normal)
    return np.where(distance[:, 0] > 0.1, np.inf, height).astype(np.float32), normal


def smooth_field(maps: LayerMaps, need: Floats, normal: Floats) -> Floats:
    """A smooth displacement (N, 3) m over the texels with u·normal ≥ need where need > 0.

    Arguments:
        need: (N,) m ≥ 0. normal: (N, 3) unit directions.
    """
    count = len(maps)
    first, second = _edges(maps)
    degree = np.maximum(np.bincount(first, minlength=count), 1).astype(np.float32)[:, None]
    asks = need > 0
    field = np.asarray(need[:, None] * normal, np.float32)
    for _ in range(_ITERATIONS):
        total = np.stack(
            [np.bincount(first, weights=field[second, k], minlength=count) for k in range(3)], axis=1
        )
        field = (_FADING * (0.5 * field + 0.5 * total / degree)).astype(np.float32)
        lacking = np.where(asks, np.clip(need - np.einsum("nk,nk->n", field, normal), 0, None), 0)
        field += lacking[:, None] * normal
    return np.asarray(field, np.float32)


def _edges(maps: LayerMaps) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Both directions of every link between texels: neighbours in a view, and seams between views."""
    neighbours, seams = maps.neighbours.numpy(), maps.seams.numpy()
    start, side = np.nonzero(neighbours >= 0)
    first = np.concatenate([start, seams[:, 0], seams[:, 1]])
    second = np.concatenate([neighbours[start, side], seams[:, 1], seams[:, 0]])
    return first, second

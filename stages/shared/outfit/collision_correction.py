"""Collision correction: moves garments of other people out of the wearer's body, pose by pose.

A garment follows the wearer's shape through the shape directions, but its offsets are those of its source.
Where the wearer is larger, or lifts a leg higher than the source did, the body would poke through. Nothing is
trained here. In every pose, each texel that is closer than `CLEARANCE` to the body that it covers needs a
displacement along the body's normal; the garment moves by a smooth field that satisfies all of them.

Which body texels a garment covers is decided once, in the canonical pose (`coverage.py`), so that a hand in
front of a skirt does not move it. Front texels are compared with the front of the body and back texels with
its back: a thigh that went through the cloth moves it forwards even where the back of the thigh is nearer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from stages.shared.avatar.deform import PosedGaussians
from stages.shared.avatar.maps import LayerMaps
from stages.shared.finite import finite, require_finite
from stages.shared.outfit.coverage import covered_weights, same_grid
from stages.shared.outfit.layer import WornLayer

CLEARANCE = 0.002  # m between a garment's Gaussians and the body's
_DEEPEST = 0.03  # m; deeper penetration is not a collision of neighbours, and moving it makes it worse
_REACH = 0.20  # m between a texel and the body point it is compared with
_NEAREST = 4  # body points that are averaged
_ITERATIONS = 40  # of smoothing; the field reaches about √40 texels beyond the constrained ones
_FADING = 0.98  # per iteration, so that the field fades with distance

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CollisionCorrection:
    """What is known of a garment before the pose.

    Attributes:
        garment: layer name.
        sides: per side (front, back): indices of garment texels, and of the body texels under them.
        smoothing: (N, N) means over the linked texels of the garment.
    """

    garment: str
    sides: tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]
    smoothing: sparse.csr_matrix

    def displacement(self, garment: PosedGaussians, body: PosedGaussians) -> Floats | None:
        """(N, 3) m, world; None without a collision."""
        points, beneath = garment.means.numpy(), body.means.numpy()
        normals = body.normals.numpy()
        need = np.zeros(len(points), np.float32)
        along = np.zeros_like(points)
        for own, covered in self.sides:
            height, along[own] = _height(points[own], beneath[covered], normals[covered])
            need[own] = np.where(height < -_DEEPEST, 0, np.clip(CLEARANCE - height, 0, None))
        if not (need > 1e-4).any():
            return None
        return smooth_field(self.smoothing, need, along)

    def applied(self, garment: PosedGaussians, body: PosedGaussians) -> PosedGaussians:
        """The garment moved out of the body."""
        field = self.displacement(garment, body)
        return garment if field is None else replace(garment, means=garment.means + torch.from_numpy(field))


def plan_correction(body: WornLayer, garment: WornLayer) -> CollisionCorrection | None:
    """The correction of one garment; None if it was learned on this body or covers none of it."""
    if (garment.source and garment.source == body.source) or not same_grid(body.maps, garment.maps):
        return None
    beneath = covered_weights(body.maps, garment.maps, feather=0.0) > 0
    sides = []
    for side in (0, 1):
        own = np.flatnonzero(garment.maps.side.numpy() == side)
        covered = np.flatnonzero(beneath & (body.maps.side.numpy() == side))
        if len(own) and len(covered) >= _NEAREST:
            sides.append((own, covered))
    return CollisionCorrection(garment.name, tuple(sides), _smoothing(garment.maps)) if sides else None


def _height(points: Floats, beneath: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Height (N,) m of points over a surface of points with normals, and its normal (N, 3) there.

    Infinite where the surface is out of reach.
    """
    distance, nearest = cKDTree(beneath).query(points, k=_NEAREST, distance_upper_bound=_REACH)
    here = np.isfinite(distance)
    nearest = np.where(here, nearest, 0)
    weights = np.where(here, 1 / np.maximum(distance, 1e-3), 0)
    weights = (weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9))[..., None].astype(np.float32)
    normal = (normals[nearest] * weights).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    base = (beneath[nearest] * weights).sum(axis=1)
    height = np.einsum("nk,nk->n", points - base, normal)
    return np.where(here[:, 0], height, np.inf).astype(np.float32), normal.astype(np.float32)


def smooth_field(smoothing: sparse.csr_matrix, need: Floats, along: Floats) -> Floats:
    """A smooth displacement u (N, 3) m with u · along ≥ need where need > 0.

    Arguments:
        smoothing: (N, N) rows that average the linked texels. need: (N,) m ≥ 0. along: (N, 3) unit.

    Raises:
        BadData: a number that is not finite.
    """
    require_finite("smooth_field", need=need, along=along)
    constrained = np.flatnonzero(need > 0)
    least, direction = need[constrained], along[constrained]
    field = np.zeros_like(along)
    field[constrained] = least[:, None] * direction
    for _ in range(_ITERATIONS):
        field = (0.5 * _FADING) * (field + smoothing @ field)
        lacking = np.clip(least - np.einsum("nk,nk->n", field[constrained], direction), 0, None)
        field[constrained] += lacking[:, None] * direction
    return finite(np.asarray(field, np.float32), "smooth_field")


def _smoothing(maps: LayerMaps) -> sparse.csr_matrix:
    """(N, N) means over neighbours in a view and across seams; a texel without neighbours keeps its value."""
    count = len(maps)
    first, second = maps.links()
    alone = np.setdiff1d(np.arange(count), first)
    first, second = np.concatenate([first, alone]), np.concatenate([second, alone])
    degree = np.bincount(first, minlength=count).astype(np.float32)
    return sparse.csr_matrix((1 / degree[first], (first, second)), shape=(count, count), dtype=np.float32)

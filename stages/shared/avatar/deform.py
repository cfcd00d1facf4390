"""From canonical Gaussians to posed ones: p = T (C + Σ β d + Δp), Σ = T R S² Rᵀ Tᵀ, T = Σ_j w_j M_j.

Linear blend skinning of centres and covariances (Gaussian Wardrobe, sec. 3.3). The covariance is carried by
the blended matrix T itself, which need not be a rotation: the Gaussian is sheared exactly as the surface is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stages.shared.avatar.maps import LayerMaps
from stages.shared.avatar.used_joints import used
from stages.shared.finite import finite, require_finite
from stages.shared.quaternions import matrices_from_quaternions, slerp


@dataclass(frozen=True)
class Attributes:
    """Canonical Gaussian attributes of one layer in one pose.

    Attributes:
        offsets: (N, 3) m, canonical, added to the texel's position.
        quaternions: (N, 4) wxyz, unit.
        scales: (N, 3) m, standard deviations.
        opacities: (N,) 0..1.
        colors: (N, 3) sRGB; 0..1 when the model bounds them.
    """

    offsets: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


@dataclass(frozen=True, eq=False)
class Replacement:
    """Attributes that take the place of a layer's own, texel by texel.

    Attributes:
        weights: (N,) from 0 (the layer's own) to 1 (replaced).
        offsets: (N, 3) m, canonical. quaternions: (N, 4) wxyz, unit.
        looks: (N, 7) colour 3 (sRGB), scales 3 (m), opacity 1; None where these stay.
        garment: name of the garment under which it applies; "" for none.
    """

    weights: Tensor
    offsets: Tensor
    quaternions: Tensor
    looks: Tensor | None = None
    garment: str = ""

    @property
    def count(self) -> int:
        """Texels that change."""
        return int((self.weights > 0).sum())

    def applied(self, attributes: Attributes) -> Attributes:
        """The attributes of the layer with this replacement."""
        weights = self.weights[:, None]
        changed = replace(
            attributes,
            offsets=torch.lerp(attributes.offsets, self.offsets, weights),
            quaternions=slerp(attributes.quaternions, self.quaternions, weights),
        )
        if self.looks is None:
            return changed
        return replace(
            changed,
            colors=torch.lerp(attributes.colors, self.looks[:, :3], weights),
            scales=torch.lerp(attributes.scales, self.looks[:, 3:6], weights),
            opacities=torch.lerp(attributes.opacities, self.looks[:, 6], self.weights),
        )


@dataclass(frozen=True)
class PosedGaussians:
    """Gaussians of one layer in world space.

    Attributes:
        means: (N, 3) m. covariances: (N, 3, 3) m². opacities: (N,). colors: (N, 3) sRGB.
        normals: (N, 3) unit, estimated from posed neighbours; without gradient.
        offsets: (N, 3) m, the canonical Δp that led here.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    normals: Tensor
    offsets: Tensor


def shaped_positions(maps: LayerMaps, betas: Tensor) -> Tensor:
    """Canonical texel positions (N, 3) m of a body with shape `betas` (10,): C + Σ_b β_b d_b."""
    shaped = maps.positions + torch.einsum("b,nbk->nk", betas, maps.shape_directions)
    return finite(shaped, "shaped_positions", betas=betas)


def blended(weights: Tensor, transforms: Tensor) -> Tensor:
    """Skinning matrices (N, 3, 4) from weights (N, 55) and bone transforms (55, 4, 4)."""
    weights, transforms = used(weights, transforms)
    return (weights @ transforms[:, :3, :].reshape(-1, 12)).view(-1, 3, 4)


def moved(points: Tensor, matrices: Tensor) -> Tensor:
    """Apply one (3, 4) matrix per point: (N, 3), (N, 3, 4) -> (N, 3)."""
    return (matrices[:, :, :3] @ points[:, :, None]).squeeze(-1) + matrices[:, :, 3]


def estimate_normals(means: Tensor, maps: LayerMaps, fallback: Tensor) -> Tensor:
    """Unit normals (N, 3) of posed texels from their map neighbours.

    Sum of the cross products of consecutive neighbour arms (right×up, up×left, left×down, down×right), which
    points outwards where texels face the front and is flipped where they face the back. Texels without two
    consecutive neighbours, or with a vanishing sum, take `fallback` (N, 3), which is normalised too.
    """
    require_finite("estimate_normals", means=means, fallback=fallback)
    here = maps.neighbours >= 0
    arms = means[maps.neighbours.clamp(min=0)] - means[:, None]  # (N, 4, 3) up, right, down, left
    arms = arms * here[:, :, None]
    total = torch.zeros_like(means)
    for first, second in ((1, 0), (0, 3), (3, 2), (2, 1)):
        total = total + torch.linalg.cross(arms[:, first], arms[:, second])
    sign = 1.0 - 2.0 * maps.side[:, None].to(means.dtype)
    total = total * sign
    finite(total, "estimate_normals", means=means)
    good = total.square().sum(dim=1, keepdim=True) > 1e-18
    chosen = torch.where(good, total, fallback)
    length = chosen.square().sum(dim=1, keepdim=True).clamp(min=1e-18).sqrt()
    return chosen / finite(length, "estimate_normals", means=means)


def view_cosines(maps: LayerMaps, transforms: Tensor, betas: Tensor, eye: Tensor) -> Tensor:
    """Cosine (N,) between each texel's carried normal and the direction to a camera at `eye` (3,) m, world.

    Positions and normals are those of the bare surface, without learned offsets; normals are carried by the
    blended matrix and keep the length it gives them (Animatable Gaussians, view conditioning).
    """
    matrices = blended(maps.skin_weights, transforms)
    towards = eye - moved(shaped_positions(maps, betas), matrices)
    towards = towards / towards.square().sum(dim=1, keepdim=True).sqrt().clamp(min=1e-3)
    carried = (matrices[:, :, :3] * maps.normals[:, None, :]).sum(dim=2)
    return (carried * towards).sum(dim=1)


def pose_layer(
    maps: LayerMaps,
    attributes: Attributes,
    transforms: Tensor,
    betas: Tensor,
    texel_matrices: Tensor | None = None,
) -> PosedGaussians:
    """Deform one layer.

    Arguments:
        maps: baked maps (N texels). attributes: canonical attributes of the same texels.
        transforms: (55, 4, 4) posed_from_canonical, canonical to world. betas: (10,) shape.
        texel_matrices: (N, 3, 4) posed_from_canonical of every texel, in place of blended `transforms`.
    """
    matrices = blended(maps.skin_weights, transforms) if texel_matrices is None else texel_matrices
    means = moved(shaped_positions(maps, betas) + attributes.offsets, matrices)
    spread = matrices[:, :, :3] @ (
        matrices_from_quaternions(attributes.quaternions) * attributes.scales[:, None, :]
    )
    covariances = spread @ spread.transpose(1, 2)
    finite(
        means.sum() + covariances.sum(),
        "pose_layer",
        offsets=attributes.offsets,
        quaternions=attributes.quaternions,
        scales=attributes.scales,
        transforms=transforms,
        betas=betas,
    )
    with torch.no_grad():
        carried = (matrices[:, :, :3] @ maps.normals[:, :, None]).squeeze(-1)
        normals = estimate_normals(means, maps, carried)
    return PosedGaussians(
        means, covariances, attributes.opacities, attributes.colors, normals, attributes.offsets
    )

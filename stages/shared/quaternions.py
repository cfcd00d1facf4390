"""Rotations as unit quaternions wxyz, in torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from stages.shared.finite import finite, require_finite


def matrices_from_quaternions(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4)."""
    w, x, y, z = quaternions.unbind(dim=-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def unit_quaternions(quaternions: Tensor) -> Tensor:
    """Normalised quaternions (N, 4). One that is nearly zero becomes the identity, with zero gradient."""
    squared = quaternions.square().sum(dim=-1, keepdim=True)
    finite(squared, "unit_quaternions", quaternions=quaternions)
    usable = squared > 1e-12
    safe = torch.where(usable, squared, torch.ones_like(squared))
    identity = quaternions.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(usable, quaternions * safe.rsqrt(), identity)


def slerp(start: Tensor, end: Tensor, weights: Tensor) -> Tensor:
    """Spherical interpolation of unit quaternions (N, 4) along the shorter arc; weights (N, 1) in 0..1."""
    require_finite("slerp", start=start, end=end, weights=weights)
    cosine = (start * end).sum(dim=1, keepdim=True)
    end = torch.where(cosine < 0, -end, end)
    straight = cosine.abs() > 1 - 1e-7  # nearly equal: interpolate linearly, since acos has no finite slope
    angle = torch.acos(torch.where(straight, 0.0, cosine.abs()))
    safe = torch.sin(angle)
    first = torch.where(straight, 1 - weights, torch.sin((1 - weights) * angle) / safe)
    second = torch.where(straight, weights, torch.sin(weights * angle) / safe)
    return functional.normalize(first * start + second * end, dim=1)


def quaternion_from_z(normals: Tensor) -> Tensor:
    """Unit quaternions (N, 4) wxyz that rotate the z axis to `normals` (N, 3).

    For −z it is a half turn about x.
    """
    require_finite("quaternion_from_z", normals=normals)
    normals = functional.normalize(normals, dim=1)
    x, y, z = normals.unbind(dim=1)
    quaternion = torch.stack((1 + z, -y, x, torch.zeros_like(x)), dim=1)  # (1 + z·n, z × n)
    opposite = (1 + z) < 1e-6
    quaternion = torch.where(opposite[:, None], quaternion.new_tensor([0.0, 1.0, 0.0, 0.0]), quaternion)
    return functional.normalize(quaternion, dim=1)

"""The scene that is measured: a clothed standing person as a cloud of small flat Gaussians. Seeded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Limbs as (start, end, radius) in metres; the legs and arms again on the other side.
_TRUNK = [
    ((0, 0.95, 0), (0, 1.4, 0), 0.2),
    ((0, 1.59, 0), (0, 1.67, 0), 0.12),
    ((0, 1.42, 0), (0, 1.53, 0), 0.08),
]
_SIDE = [
    ((0.2, 1.4, 0), (0.43, 1.15, 0.02), 0.07),
    ((0.43, 1.15, 0.02), (0.62, 0.9, 0.08), 0.06),
    ((0.1, 0.92, 0), (0.15, 0.5, 0.02), 0.11),
    ((0.15, 0.5, 0.02), (0.18, 0.08, -0.02), 0.08),
    ((0.18, 0.05, -0.02), (0.2, 0.04, 0.14), 0.055),
]


@dataclass(frozen=True)
class Figure:
    """means (N, 3) m, quats (N, 4), scales (N, 3) m, opacities (N,), colors (N, C): for `rasterize`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor


def make_figure(count: int, channels: int, seed: int = 0) -> Figure:
    """`count` Gaussians: 3 to 6 mm along the surface, 1 to 2 mm thick, 85 % of opacities above one half."""
    rng = np.random.default_rng(seed)
    mirrored = [((-a[0], *a[1:]), (-b[0], *b[1:]), r) for a, b, r in _SIDE]
    limbs = [*_TRUNK, *_SIDE, *mirrored]
    start, end = (np.array([limb[i] for limb in limbs], np.float64) for i in (0, 1))
    radius = np.array([limb[2] for limb in limbs])
    length = np.linalg.norm(end - start, axis=1)
    area = radius * (length + 2 * radius)
    which = rng.choice(len(limbs), count, p=area / area.sum())
    # A point of a capsule's surface: along the axis, rounded off at both ends.
    axis = ((end - start) / length[:, None])[which]
    along = rng.uniform(-radius[which], length[which] + radius[which])
    over = along - np.clip(along, 0, length[which])
    ring = np.sqrt(np.maximum(radius[which] ** 2 - over**2, 1e-12))
    side = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]]))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = rng.uniform(0, 2 * math.pi, count)[:, None]
    outward = ring[:, None] * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    normal = outward + over[:, None] * axis
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    means = start[which] + along[:, None] * axis + outward + rng.normal(0, 0.002, (count, 1)) * normal
    flat = np.exp(rng.uniform(math.log(0.003), math.log(0.006), (count, 2)))
    opaque = rng.uniform(size=count) < 0.85
    arrays = (
        means,
        _turn_z_to(normal),
        np.concatenate([flat, rng.uniform(0.0008, 0.002, (count, 1))], 1),
        np.where(opaque, rng.uniform(0.5, 0.99, count), rng.uniform(0.05, 0.5, count)),
        np.clip(0.5 + 0.5 * np.sin(means @ rng.normal(0, 8, (3, channels))), 0, 1),
    )
    return Figure(*(torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in arrays))


def _turn_z_to(normal: np.ndarray) -> np.ndarray:
    """(N, 3) unit vectors -> (N, 4) quaternions that turn +z there: half way between, as a half turn."""
    quats = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(len(normal))], 1)
    quats[np.linalg.norm(quats, axis=1) < 1e-6] = (0, 1, 0, 0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def make_camera(size: int) -> tuple[Tensor, Tensor]:
    """viewmat (4, 4) and K (3, 3) of a 45 degree camera 2.25 m in front of the figure."""
    focal = 0.5 * size / math.tan(math.radians(45) / 2)
    view = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    view[1, 3], view[2, 3] = 0.87, 2.25
    return view, torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])

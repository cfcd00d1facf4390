"""Small synthetic layers for tests: upright elliptic tubes baked the way `gw bake-maps` would."""

from __future__ import annotations

import numpy as np

from stages.shared.avatar.maps import LayerMaps

GRID = 100
PITCH = 0.02
CENTRE = (0.0, 0.0, 0.0)


def tube_arrays(
    radius: float = 0.15,
    low: float = -0.3,
    high: float = 0.3,
    color: tuple[float, float, float] = (0.8, 0.4, 0.2),
    pitch: float = PITCH,
    grid: int = GRID,
) -> dict[str, np.ndarray]:
    """Arrays of a bake-maps layer: a tube about the y axis, twice as wide (x) as deep (z)."""
    rows, cols = np.meshgrid(np.arange(grid), np.arange(grid), indexing="ij")
    x = ((cols + 0.5) - grid / 2) * pitch
    y = -((rows + 0.5) - grid / 2) * pitch
    inside = (np.abs(x) < radius) & (y > low) & (y < high)
    depth = 0.5 * np.sqrt(np.maximum(radius**2 - x**2, 0))
    texels, positions, normals = [], [], []
    for view, sign in ((0, 1.0), (1, -1.0)):
        r, c = np.nonzero(inside)
        z = sign * depth[r, c]
        texels.append(np.stack([np.full_like(r, view), r, c], 1))
        positions.append(np.stack([x[r, c], y[r, c], z], 1))
        normal = np.stack([x[r, c] / radius**2, np.zeros_like(z), 4 * z / radius**2], 1)
        normals.append(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    texel, position, normal = np.concatenate(texels), np.concatenate(positions), np.concatenate(normals)
    count = len(texel)
    index = np.full((2, grid + 2, grid + 2), -1)
    index[texel[:, 0], texel[:, 1] + 1, texel[:, 2] + 1] = np.arange(count)
    steps = ((-1, 0), (0, 1), (1, 0), (0, -1))
    neighbours = np.stack(
        [index[texel[:, 0], texel[:, 1] + 1 + dr, texel[:, 2] + 1 + dc] for dr, dc in steps], 1
    )
    left = np.nonzero(neighbours[:, 3] < 0)[0]
    front = left[texel[left, 0] == 0]
    seams = np.stack([front, index[1, texel[front, 1] + 1, texel[front, 2] + 1]], 1)
    weights = np.zeros((count, 55))
    upper = 1 / (1 + np.exp(-position[:, 1] / 0.05))
    weights[:, 3], weights[:, 0] = upper, 1 - upper
    directions = np.zeros((count, 10, 3))
    directions[:, 0] = normal * 0.01
    directions[:, 1, 1] = 0.02 * position[:, 1]
    stripes = (np.floor(position[:, 1] / 0.1).astype(int) % 2)[:, None]
    r0, c0 = texel[:, 1].min(), texel[:, 2].min()
    window = [r0, c0, texel[:, 1].max() - r0 + 1, texel[:, 2].max() - c0 + 1]
    return {
        "texels": texel.astype(np.int32),
        "window": np.array(window, np.int32),
        "positions": position.astype(np.float32),
        "normals": normal.astype(np.float32),
        "skin_weights": weights.astype(np.float32),
        "shape_directions": directions.astype(np.float32),
        "neighbours": neighbours.astype(np.int32),
        "seams": seams.astype(np.int32),
        "spacing": np.full(count, pitch * 0.6, np.float32),
        "colors": (np.array(color) * (0.4 + 0.6 * stripes)).astype(np.float32),
        "color_confidence": np.ones(count, np.float32),
    }


def tube(layer: str = "body", **shape: object) -> LayerMaps:
    """The same as `LayerMaps`."""
    return LayerMaps.from_arrays(layer, tube_arrays(**shape), PITCH, CENTRE, GRID)  # type: ignore[arg-type]

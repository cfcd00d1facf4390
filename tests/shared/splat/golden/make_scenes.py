"""Golden splat scenes: a rasteriser in plain NumPy, written from the formula alone, and the scenes it drew.

It shares no code with the product. Every pixel visits every Gaussian in float64:

    Σ' = J W Σ Wᵀ Jᵀ + 0.3 I,   α = min(0.999, o · exp(−½ dᵀ Σ'⁻¹ d)),   C = Σ_k c_k α_k Π_{j<k} (1 − α_j)

Alphas below 1/255 do not count. A pixel stops before the Gaussian that would take its transmittance to 1e-4
or below. J is taken inside the image, widened by 0.3 of half its size on every side. Gaussians of equal
float32 depth keep their order. Gradients are central differences of the whole picture.

Make the files again: python -m tests.shared.splat.golden.make_scenes
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

Floats = NDArray[np.float64]
Scene = dict[str, NDArray[np.float32]]
FOLDER = Path(__file__).parent
STEP = 1e-5  # of the central differences


def rotation(quaternion: Floats) -> Floats:
    """(3, 3) of wxyz, by turning the three axes with q v q*."""
    w, axis = quaternion[0], quaternion[1:]
    norm = math.sqrt(w * w + axis @ axis)
    w, axis = w / norm, axis / norm
    columns = [e + 2 * np.cross(axis, np.cross(axis, e) + w * e) for e in np.eye(3)]
    return np.stack(columns, axis=1)


def draw(scene: dict[str, Floats], width: int, height: int) -> tuple[Floats, Floats, Floats]:
    """Colours (H, W, 3) on black, alpha (H, W) and the sum of weight times depth (H, W)."""
    view, k = scene["viewmat"], scene["intrinsics"]
    focal, middle = np.array([k[0, 0], k[1, 1]]), np.array([k[0, 2], k[1, 2]])
    points = [view[:3, :3] @ mean + view[:3, 3] for mean in scene["means"]]
    order = sorted(range(len(points)), key=lambda n: np.float32(points[n][2]))
    splats = []
    for n in order:
        x, y, z = points[n]
        if z <= 0.01:
            continue
        size = np.array([width, height])
        low, high = -middle / focal, (size - middle) / focal
        margin = 0.3 * 0.5 * size / focal
        u, v = np.clip([x / z, y / z], low - margin, high + margin)
        jacobian = np.array([[focal[0] / z, 0, -focal[0] * u / z], [0, focal[1] / z, -focal[1] * v / z]])
        axes = rotation(scene["quats"][n]) @ np.diag(scene["scales"][n])
        to_image = jacobian @ view[:3, :3] @ axes
        inverse = np.linalg.inv(to_image @ to_image.T + 0.3 * np.eye(2))
        splats.append((n, focal * (x, y) / z + middle, inverse, z))
    color, alpha, depth = np.zeros((height, width, 3)), np.zeros((height, width)), np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            left = 1.0
            for n, center, inverse, z in splats:
                d = np.array([column + 0.5, row + 0.5]) - center
                a = scene["opacities"][n] * math.exp(-0.5 * d @ inverse @ d)
                if a < 1 / 255:
                    continue
                a = min(a, 0.999)
                if left * (1 - a) <= 1e-4:
                    break
                color[row, column] += left * a * scene["colors"][n]
                depth[row, column] += left * a * z
                left *= 1 - a
            alpha[row, column] = 1 - left
    return color, alpha, depth


def random_scene(seed: int, count: int, size: tuple[float, float], opacity: tuple[float, float]) -> Scene:
    """Gaussians in front of a turned camera; `size` in m and `opacity` are ranges."""
    random = np.random.default_rng(seed)
    view = np.eye(4)
    view[:3, :3] = rotation(np.array([0.96, 0.1, -0.2, 0.05]))
    view[:3, 3] = (0.05, -0.1, 2.0)
    return {
        "means": random.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        "quats": random.normal(size=(count, 4)).astype(np.float32),
        "scales": random.uniform(*size, (count, 3)).astype(np.float32),
        "opacities": random.uniform(*opacity, count).astype(np.float32),
        "colors": random.uniform(0, 1, (count, 3)).astype(np.float32),
        "viewmat": view.astype(np.float32),
        "intrinsics": np.array([[26, 0, 10.3], [0, 24, 7.6], [0, 0, 1]], np.float32),
    }


def crowded_scene() -> Scene:
    """Small and flat Gaussians, opaque stacks, equal depths, one behind the camera, one far outside."""
    scene = random_scene(2, 24, (0.01, 0.25), (0.2, 1.0))
    scene["scales"][:, 2] *= 0.02
    scene["means"][1] = scene["means"][0]  # equal depth: the first is drawn first
    scene["means"][2:6] = np.array([0.1, 0.1, 0.0]) + 0.05 * np.arange(4)[:, None]
    scene["scales"][2:6], scene["opacities"][2:6] = 0.3, 0.97
    scene["means"][6] = (0.0, 0.0, -3.0)
    scene["means"][7] = (3.5, 0.2, 0.1)
    scene["scales"][7] = 0.8
    return scene


def gradients(scene: dict[str, Floats], weights: Floats, width: int, height: int) -> dict[str, Floats]:
    """Derivatives of Σ weights · colours by all inputs of the Gaussians, by central differences."""
    slopes = {}
    for name in ("means", "quats", "scales", "opacities", "colors"):
        slope = np.zeros_like(scene[name])
        for index in np.ndindex(slope.shape):
            ends = []
            for sign in (1, -1):
                moved = {**scene, name: scene[name].copy()}
                moved[name][index] += sign * STEP
                ends.append(float((draw(moved, width, height)[0] * weights).sum()))
            slope[index] = (ends[0] - ends[1]) / (2 * STEP)
        slopes[f"gradient.{name}"] = slope
    return slopes


def main() -> None:
    """Write smooth.safetensors and crowded.safetensors next to this file."""
    width, height = 20, 15
    for name, scene in (("smooth", random_scene(1, 6, (0.6, 0.9), (0.2, 0.5))), ("crowded", crowded_scene())):
        exact = {key: value.astype(np.float64) for key, value in scene.items()}
        picture = dict(zip(("features", "alpha", "depth"), draw(exact, width, height), strict=True))
        if name == "smooth":  # no pixel is near a cut-off, so that differences are derivatives
            weights = np.random.default_rng(3).normal(size=(height, width, 3)).astype(np.float32)
            picture |= {"weights": weights, **gradients(exact, weights.astype(np.float64), width, height)}
        save_file(
            {**scene, **{key: value.astype(np.float32) for key, value in picture.items()}},
            FOLDER / f"{name}.safetensors",
        )


if __name__ == "__main__":
    main()

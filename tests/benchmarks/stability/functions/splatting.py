"""Splatting, forward and backward, in every backend that runs here; the float64 reference is the truth.

Gaussians fainter than 1/255 at a pixel are left out: float32 and float64 may differ by one such step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from stages.shared.splat.api import rasterize
from stages.shared.splat.cuda import why_not
from tests.benchmarks.stability.function import Function, Inputs, unit

_SIDE = 24
_ROWS = 20
_STEP = 5e-3  # one left-out contribution of 1/255, and some


def _scene(random: np.random.Generator, depth: float = 3.0, focal: float = 30.0) -> Inputs:
    means = random.uniform(-0.8, 0.8, (_ROWS, 3))
    means[:, 2] += depth
    return {
        "means": means,
        "quats": unit(random, _ROWS, 4),
        "scales": random.uniform(0.05, 0.3, (_ROWS, 3)),
        "opacities": random.uniform(0.2, 0.9, _ROWS),
        "colors": random.random((_ROWS, 3)),
        "viewmats": np.eye(4),
        "Ks": np.array([[focal, 0, _SIDE / 2], [0, focal, _SIDE / 2], [0, 0, 1]]),
    }


def _sizes(metres: float, random: np.random.Generator) -> Inputs:
    return {**_scene(random), "scales": metres * random.uniform(0.5, 1, (_ROWS, 3))}


def _needles(aspect: float, random: np.random.Generator) -> Inputs:
    scales = np.full((_ROWS, 3), 0.3 / aspect)
    scales[:, 0] = 0.3
    return {**_scene(random), "scales": scales}


def _turned(length: float, random: np.random.Generator) -> Inputs:
    return {**_scene(random), "quats": length * unit(random, _ROWS, 4)}


def _faint(opacity: float, random: np.random.Generator) -> Inputs:
    return {**_scene(random), "opacities": np.full(_ROWS, opacity)}


def _far(metres: float, random: np.random.Generator) -> Inputs:
    scene = _scene(random)
    scene["means"] = scene["means"] / 3.0 * metres
    scene["scales"] = np.abs(scene["scales"] / 3.0 * metres)
    return scene


def _zoomed(focal: float, random: np.random.Generator) -> Inputs:
    return _scene(random, focal=focal)


def _bright(size: float, random: np.random.Generator) -> Inputs:
    return {**_scene(random), "colors": size * random.uniform(-1, 1, (_ROWS, 3))}


def _render(backend: str) -> Callable[[dict[str, Any]], torch.Tensor]:
    def call(a: dict[str, Any]) -> torch.Tensor:
        picture = rasterize(**a, width=_SIDE, height=_SIDE, backend=backend)
        return torch.cat([picture.features, picture.alpha[..., None]], dim=-1)

    return call


_AXES: tuple[tuple[str, tuple[float, ...], Callable[..., Inputs], tuple[float, float]], ...] = (
    ("standard deviation, m", (1e-30, 1e-9, 1e-3, 0.1, 10.0, 1e3, 1e6), _sizes, (1e-3, 10.0)),
    ("aspect of needles", (1.0, 1e2, 1e4, 1e6), _needles, (1.0, 1e4)),
    ("length of the quaternion", (0.0, 1e-30, 1e-12, 1.0, 1e12, 1e30), _turned, (1e-12, 1e12)),
    ("opacity", (0.0, 1e-12, 0.5, 1 - 1e-12, 1.0), _faint, (0.0, 1.0)),
    ("depth of the scene, m", (-3.0, 1e-30, 1e-3, 3.0, 1e3, 1e6, 1e18), _far, (3.0, 1e6)),
    ("focal length, px", (1e-3, 1.0, 30.0, 1e3, 1e5), _zoomed, (1.0, 1e3)),
    ("colour", (0.0, 1e-30, 1.0, 1e6, 1e30), _bright, (0.0, 1e6)),
)
_BACKENDS = ("reference", "cpu") + (("cuda",) if why_not() is None else ())

SPLATTING = tuple(
    Function(
        f"rasterize ({backend})", "splatting", axis, magnitudes, inputs, _render(backend),
        everyday=everyday, tolerance=_STEP, gradients=("means", "quats", "scales", "opacities", "colors"),
        gradient_tolerance=math.inf if axis.startswith("aspect") else 5e-2,
        truth=_render("reference"), single=backend != "reference",
    )
    for axis, magnitudes, inputs, everyday in _AXES
    for backend in _BACKENDS
)  # fmt: skip

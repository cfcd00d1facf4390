"""Every loss, by the size of the numbers it compares."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch

from stages.shared.losses.flow import flow_loss
from stages.shared.losses.perceptual import Perceptual, tensor_shapes
from stages.shared.losses.picture import l1, label_loss, silhouette_loss, ssim_loss
from stages.shared.losses.surface import (
    covered_skin_loss,
    offset_loss,
    opacity_loss,
    penetration_loss,
    seam_loss,
    smooth_loss,
)
from tests.benchmarks.stability.function import Function, Inputs, unit

_SIZES = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e12, 1e30)
_METRES = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e12, 1e30)
_SIDE = 16
_CHAIN = torch.tensor([[-1, 1, -1, -1], [-1, 2, -1, 0], [-1, 3, -1, 1], [-1, -1, -1, 2]])
_PAIRS = torch.tensor([[0, 1], [2, 3]])
_FIRST = torch.tensor([True, True, False, False])


def _pictures(channels: int) -> Callable[[float, np.random.Generator], Inputs]:
    def inputs(size: float, random: np.random.Generator) -> Inputs:
        shape = (_SIDE, _SIDE, channels) if channels else (_SIDE, _SIDE)
        return {"image": size * random.random(shape), "truth": size * random.random(shape)}

    return inputs


def _offsets(metres: float, random: np.random.Generator) -> Inputs:
    return {"offsets": metres * unit(random, 4)}


def _offsets_and_colors(metres: float, random: np.random.Generator) -> Inputs:
    return {"offsets": metres * unit(random, 4), "colors": random.random((4, 3))}


def _surfaces(metres: float, random: np.random.Generator) -> Inputs:
    inner = unit(random, 30)
    return {"outer": inner + metres * unit(random, 30), "inner": inner, "inner_normals": inner.copy()}


def _flow(pixels: float, random: np.random.Generator) -> Inputs:
    means = random.uniform(-0.2, 0.2, (20, 3))
    means[:, 2] = 2.0
    return {
        "means": means,
        "viewmat": np.eye(4),
        "intrinsics": np.array([[30.0, 0, 8], [0, 30, 8], [0, 0, 1]]),
        "depth": np.full((_SIDE, _SIDE), 2.0),
        "flow": pixels * unit(random, _SIDE * _SIDE, 2).reshape(_SIDE, _SIDE, 2),
    }


def _flow_cost(a: dict[str, Any]) -> torch.Tensor:
    return flow_loss(**a, trusted=torch.ones(_SIDE, _SIDE, dtype=torch.bool))


@cache
def _perceptual(dtype: torch.dtype) -> Perceptual:
    """The network of LPIPS with random weights that keep the size of its features."""
    random = torch.Generator().manual_seed(0)
    tensors = {}
    for name, shape in tensor_shapes().items():
        fan_in = max(1, int(np.prod(shape[1:])))
        values = torch.randn(shape, generator=random) * (2.0 / fan_in) ** 0.5
        tensors[name] = values.abs() if name.startswith("lin") else values if len(shape) > 1 else 0.0 * values
    return Perceptual({name: tensor.to(dtype) for name, tensor in tensors.items()})


def _lpips(a: dict[str, Any]) -> torch.Tensor:
    return _perceptual(a["image"].dtype).distance(a["image"], a["truth"])


def _loss(
    name: str,
    axis: str,
    inputs: Callable[[float, np.random.Generator], Inputs],
    call: Callable[[dict[str, Any]], torch.Tensor],
    gradients: tuple[str, ...],
    everyday: tuple[float, float] = (1e-12, 1e12),
    **more: Any,
) -> Function:
    sizes = more.pop("magnitudes", _METRES if axis.endswith("m") else _SIZES)
    return Function(name, "losses", axis, sizes, inputs, call, everyday, gradients=gradients, **more)


LOSSES = (
    _loss("l1", "colour", _pictures(3), lambda a: l1(a["image"], a["truth"]), ("image",), bfloat16=True),
    _loss(
        "ssim_loss", "colour", _pictures(3), lambda a: ssim_loss(a["image"], a["truth"]), ("image",),
        (1e-3, 1.0), tolerance=1e-4, gradient_tolerance=1e-2,
    ),
    _loss(
        "lpips", "colour", _pictures(3), _lpips, ("image",), (1e-3, 1.0), tolerance=1e-4,
        gradient_tolerance=1e-2, magnitudes=(0.0, 1e-3, 1.0, 1e3, 1e30),
    ),
    _loss(
        "label_loss (l1)", "label", _pictures(3),
        lambda a: label_loss(a["image"], a["truth"], torch.ones_like(a["image"][..., 0])), ("image",),
        bfloat16=True,
    ),
    _loss(
        "label_loss (l2)", "label", _pictures(3),
        lambda a: label_loss(a["image"], a["truth"], torch.ones_like(a["image"][..., 0]), "l2"), ("image",),
    ),
    _loss(
        "silhouette_loss", "opacity", _pictures(0), lambda a: silhouette_loss(a["image"], a["truth"]),
        ("image",), bfloat16=True,
    ),
    _loss(
        "penetration_loss", "depth of the penetration, m", _surfaces, lambda a: penetration_loss(**a),
        ("outer",), (1e-3, 1e-3), gradient_tolerance=1e-2,
    ),
    _loss(
        "offset_loss", "offset, m", _offsets, lambda a: offset_loss(a["offsets"]), ("offsets",),
        bfloat16=True,
    ),
    _loss("smooth_loss", "offset, m", _offsets, lambda a: smooth_loss(a["offsets"], _CHAIN), ("offsets",)),
    _loss(
        "seam_loss", "offset, m", _offsets_and_colors,
        lambda a: seam_loss(a["offsets"], a["colors"], _PAIRS), ("offsets", "colors"),
    ),
    _loss(
        "opacity_loss", "opacity", lambda size, random: {"opacities": np.full(4, size)},
        lambda a: opacity_loss(a["opacities"]), ("opacities",), (1e-12, 0.999),
        magnitudes=(0.0, 1e-30, 1e-12, 2e-6, 0.5, 0.999, 1.0), bfloat16=True,
    ),
    _loss(
        "covered_skin_loss", "colour", lambda size, random: {"colors": size * random.random((4, 3))},
        lambda a: covered_skin_loss(a["colors"], _FIRST, ~_FIRST), ("colors",),
    ),
    _loss(
        "flow_loss", "flow, px", _flow, _flow_cost, ("means",), (1e-3, 1e12), tolerance=1e-4,
        gradient_tolerance=1e-3,
    ),
)  # fmt: skip

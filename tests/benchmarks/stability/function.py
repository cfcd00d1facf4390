"""One numerical function, with inputs of any size to try it on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Inputs = dict[str, np.ndarray]


@dataclass(frozen=True)
class Function:
    """A public function of `stages.shared`, as the stability table and the tests of extremes see it.

    Attributes:
        name, family: e.g. "skin", "skinning".
        axis: what a magnitude is, with its unit: "angle, rad".
        magnitudes: from nothing to absurd.
        inputs: magnitude and random generator -> float64 arrays by name.
        call: arrays (tensors, or NumPy arrays when `numpy` is set) by name -> the result.
        everyday: range of magnitudes in which float32 must be within `tolerance` of float64.
        tolerance: relative, of the largest entry of the result.
        numpy: `call` takes NumPy arrays, in float64 inside.
        gradients: inputs by which the result is differentiated.
        gradient_tolerance: as `tolerance`, for the gradients.
        bfloat16: whether the function is offered in bfloat16.
        truth: what the result is compared with, in float64; by default `call` itself.
        single: the function computes in float32 whatever it is given, so there is no float64 of it.
    """

    name: str
    family: str
    axis: str
    magnitudes: tuple[float, ...]
    inputs: Callable[[float, np.random.Generator], Inputs]
    call: Callable[[dict[str, Any]], Any]
    everyday: tuple[float, float]
    tolerance: float = 1e-5
    numpy: bool = False
    gradients: tuple[str, ...] = ()
    gradient_tolerance: float = 1e-4
    bfloat16: bool = False
    truth: Callable[[dict[str, Any]], Any] | None = None
    single: bool = False


def unit(random: np.random.Generator, rows: int, columns: int = 3) -> np.ndarray:
    """Random rows of length one."""
    values = random.normal(size=(rows, columns))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def weights(random: np.random.Generator, rows: int, columns: int = 55) -> np.ndarray:
    """Rows of four positive numbers that sum to one, as skinning weights have them."""
    values = np.zeros((rows, columns))
    for row in values:
        row[random.choice(columns, 4, replace=False)] = random.dirichlet(np.ones(4))
    return values

"""Relative errors of a function at one magnitude, in one precision."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stages.shared.errors import BadData
from tests.benchmarks.stability.function import Function, Inputs

_NUMPY = {"float64": np.float64, "float32": np.float32}
_TORCH = {"float64": torch.float64, "float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True)
class Measured:
    """One row of the table.

    Attributes:
        outcome: "finite", "refused" or "not finite"; the last is a defect.
        error: largest difference from the truth over the truth's largest entry; None unless finite.
        gradient_error: the same of the gradients, the worst of all inputs; None without.
        refusal: what was said, with the name of the array.
    """

    function: str
    family: str
    axis: str
    magnitude: float
    precision: str
    outcome: str
    error: float | None = None
    gradient_error: float | None = None
    refusal: str = ""


def precisions(function: Function) -> tuple[str, ...]:
    """In which precisions a function is offered."""
    first = () if function.single else ("float64",)
    return (*first, "float32", *(("bfloat16",) if function.bfloat16 else ()))


def inputs_of(function: Function, magnitude: float, precision: str, seed: int = 0) -> Inputs:
    """Inputs in float64 whose numbers are exact in `precision`; infinity where they are beyond it."""
    random = np.random.default_rng([seed, zlib.crc32(f"{function.name} {function.axis}".encode())])
    drawn = function.inputs(magnitude, random)
    with np.errstate(over="ignore"):
        return {name: _rounded(values, precision) for name, values in drawn.items()}


def measure(function: Function, magnitude: float, precision: str, seed: int = 0) -> Measured:
    """Compare a precision with float64 on the same numbers; float64 with itself, inputs moved by one bit."""
    inputs = inputs_of(function, magnitude, precision, seed)
    about = (function.name, function.family, function.axis, magnitude, precision)
    try:
        result, gradients = evaluate(function, function.call, inputs, precision)
    except BadData as refusal:
        return Measured(*about, "refused", refusal=refusal.what)
    if not all(np.isfinite(array).all() for array in (result, *gradients.values())):
        return Measured(*about, "not finite")
    compared = (
        {name: np.nextafter(a, np.inf) for name, a in inputs.items()} if precision == "float64" else inputs
    )
    try:
        truth, true_gradients = evaluate(function, function.truth or function.call, compared, "float64")
    except BadData as refusal:  # what float64 refuses has no truth to differ from
        return Measured(*about, "finite", refusal=refusal.what)
    slopes = [relative_error(gradients[name], true_gradients[name]) for name in gradients]
    return Measured(*about, "finite", relative_error(result, truth), max(slopes, default=None))


def evaluate(
    function: Function, call: Callable[[dict[str, Any]], Any], inputs: Inputs, precision: str
) -> tuple[np.ndarray, Inputs]:
    """Result and gradients (of a fixed weighted sum of the result) in one precision, as float64 arrays."""
    if function.numpy:
        with np.errstate(all="ignore"):
            given = {name: values.astype(_NUMPY[precision]) for name, values in inputs.items()}
            return np.asarray(call(given), np.float64), {}
    tensors = {name: torch.tensor(values).to(_TORCH[precision]) for name, values in inputs.items()}
    leaves = {name: tensors[name].requires_grad_() for name in function.gradients}
    result = call(tensors)
    gradients: Inputs = {}
    if leaves and result.requires_grad:
        share = torch.linspace(0.5, 1.5, result.numel(), dtype=torch.float64).to(result.dtype)
        total = (result.flatten() * share).sum()
        found = torch.autograd.grad(total, list(leaves.values()), allow_unused=True)
        gradients = {n: g.double().numpy() for n, g in zip(leaves, found, strict=True) if g is not None}
    return result.detach().double().numpy(), gradients


def relative_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest difference over the truth's largest entry; 0 where both are 0."""
    largest = float(np.abs(truth).max(initial=0.0))
    difference = float(np.abs(found - truth).max(initial=0.0))
    if difference == 0:
        return 0.0
    return difference / largest if largest > 0 else math.inf


def _rounded(values: np.ndarray, precision: str) -> np.ndarray:
    if precision == "float64":
        return np.asarray(values, np.float64)
    return torch.tensor(np.asarray(values, np.float64)).to(_TORCH[precision]).double().numpy()

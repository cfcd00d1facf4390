"""Checks for NaN and infinity. The error names the array and the index.

A function checks its result first. One sum over it is cheap, and NaN or infinity in an input that matters
also appears in the sum. The inputs are searched only when the sum is not finite.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from stages.shared.errors import BadData

Array = TypeVar("Array")


def finite(result: Array, function: str, **inputs: Any) -> Array:
    """Return `result` if all of it is finite.

    Arguments:
        result: tensor or array of any shape.
        function: name for the message.
        inputs: what it was computed from, by name. None and arrays of integers are ignored.

    Raises:
        BadData: the first input that is not finite, with the index. If all inputs are finite: the index in
            the result at which a number exceeded the range of its type.
    """
    if not _all_finite(result):
        require_finite(function, **inputs)
        index = _first_not_finite(result)
        raise BadData(
            f"The result of {function} is beyond what {_type(result)} can hold.",
            f"{function}{_brackets(index)}",
            "Look at the size of its inputs; nothing was made of it.",
        )
    return result


def require_finite(function: str, **inputs: Any) -> None:
    """Check inputs of a function whose result would not show NaN and infinity.

    Raises:
        BadData: an input is not finite. The error names the array and the index.
    """
    for name, array in inputs.items():
        if array is None or not _is_floating(array) or _all_finite(array):
            continue
        index = _first_not_finite(array)
        raise BadData(
            f"{name}{_brackets(index)} is {_value(array, index)}, not a finite number.",
            f"{name}{_brackets(index)} of {function}",
            "Look for the step that wrote it; nothing was made of it.",
        )


def _all_finite(array: Any) -> bool:
    """Whether all entries are finite. A finite sum shows it; otherwise every entry is checked."""
    if isinstance(array, np.ndarray | np.floating | float):
        with np.errstate(all="ignore"):
            return bool(np.isfinite(np.sum(array))) or bool(np.isfinite(array).all())
    array = array.detach()
    return bool(array.sum().isfinite()) or bool(array.isfinite().all())


def _is_floating(array: Any) -> bool:
    if isinstance(array, np.ndarray):
        return array.dtype.kind == "f"
    return isinstance(array, float) or bool(getattr(array, "is_floating_point", lambda: False)())


def _first_not_finite(array: Any) -> list[int]:
    values = (
        array
        if isinstance(array, np.ndarray | np.floating | float)
        else array.detach().double().cpu().numpy()
    )
    wrong = np.argwhere(~np.isfinite(values))
    return [int(i) for i in wrong[0]] if len(wrong) else []


def _value(array: Any, index: list[int]) -> float:
    value = array[tuple(index)] if index else array
    return float(value.detach() if hasattr(value, "detach") else value)


def _type(array: Any) -> str:
    return str(getattr(array, "dtype", "float64")).removeprefix("torch.")


def _brackets(index: list[int]) -> str:
    return "".join(f"[{i}]" for i in index)

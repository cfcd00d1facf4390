"""Every public numerical function, from nothing to absurd: finite, or refused by array and index.

Where the numbers are those of everyday work, float32 agrees with float64.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from stages.shared.errors import BadData
from stages.shared.losses import flow, picture, surface
from tests.benchmarks.stability.function import Function
from tests.benchmarks.stability.functions import FUNCTIONS
from tests.benchmarks.stability.measure import evaluate, inputs_of, measure, precisions

SIZES = [
    pytest.param(
        function, magnitude, precision, id=f"{function.name}-{function.axis}-{magnitude:g}-{precision}"
    )
    for function in FUNCTIONS
    for magnitude in function.magnitudes
    for precision in precisions(function)
]
SPOILED = [
    pytest.param(function, name, value, id=f"{function.name}-{function.axis}-{name}-{value}")
    for function in FUNCTIONS
    if not (function.family == "splatting" and function.axis != "opacity")
    for name, values in inputs_of(function, function.everyday[1], "float32").items()
    if values.shape  # a lone number, as a frame rate, is an option
    for value in (np.nan, np.inf, -np.inf)
]


def test_there_are_enough() -> None:
    assert len(SIZES) + len(SPOILED) >= 400
    families = {function.family for function in FUNCTIONS}
    assert families >= {"rotations", "skinning", "shapes", "voxel sampling", "projection"}
    assert families >= {"splatting", "normals", "losses", "bundles", "pose models", "try-on"}
    names = {function.name for function in FUNCTIONS}
    assert names >= {
        *("rotation_matrices", "unit_quaternions", "slerp", "skin", "inverse_skin", "bone_transforms"),
        *("VoxelField.sample", "inverse_distance_matrix", "shaped_positions", "shaped_vertices"),
        *("Camera.project", "perspective", "image_covariances", "rasterize (reference)", "rasterize (cpu)"),
        *("face_normals", "vertex_normals", "estimate_normals", "PosePrior", "KeyPoseOffsets"),
        *("PoseCoefficients", "recent_motion", "resample", "decoder to picture", "smooth_field"),
        *("arrays on disk", "16-bit tensor", "16-bit skin weights", "pack_body"),
    }
    losses = {
        name
        for module in (flow, picture, surface)
        for name, value in vars(module).items()
        if name.endswith("_loss") and getattr(value, "__module__", "") == module.__name__
    }
    tried = {function.name.split(" ")[0] for function in FUNCTIONS}
    tried |= {f"{name}_loss" for name in tried}
    assert losses | {"l1", "lpips"} <= tried, losses - tried


@pytest.mark.parametrize(("function", "magnitude", "precision"), SIZES)
def test_any_size_is_finite_or_refused(function: Function, magnitude: float, precision: str) -> None:
    found = measure(function, magnitude, precision)
    assert found.outcome in ("finite", "refused"), found
    everyday = function.everyday[0] <= magnitude <= function.everyday[1]
    if found.outcome == "refused":
        assert not everyday or precision == "bfloat16", found
        assert re.search(r"\[\d|beyond what|cannot be stored|size|step", found.refusal), found.refusal
    elif everyday and precision == "float32":
        assert found.error is not None and found.error <= function.tolerance, found
        if found.gradient_error is not None:
            assert found.gradient_error <= function.gradient_tolerance, found


@pytest.mark.parametrize(("function", "name", "value"), SPOILED)
def test_one_number_that_is_none(function: Function, name: str, value: float) -> None:
    """Either the refusal names the array and the index, or the number did not reach the result."""
    inputs = inputs_of(function, function.everyday[1], "float32")
    good, _ = evaluate(function, function.call, inputs, "float32")
    spoiled = np.array(inputs[name])
    index = tuple(np.array(spoiled.shape) // 2)
    spoiled[index] = value
    try:
        result, gradients = evaluate(function, function.call, inputs | {name: spoiled}, "float32")
    except BadData as refusal:
        said = f"{refusal.what} {refusal.where}"
        place = "".join(rf"\[{i}\]" for i in index)
        row = rf"\[{index[0]}\]" if index else ""
        assert re.search(rf"{place}|{row}|index \[{', '.join(map(str, index))}\]", said), said
        return
    assert np.isfinite(result).all() and all(np.isfinite(g).all() for g in gradients.values())
    np.testing.assert_array_equal(result, good)

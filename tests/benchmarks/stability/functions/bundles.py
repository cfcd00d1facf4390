"""What numbers become on disk: exact in artifacts, 16-bit steps in packed body models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts.arrays import decode_arrays, encode_arrays
from stages.shared.artifacts.bundle_precision import halved, whole
from stages.shared.body import BodyModel, embedded_body
from stages.shared.body.packed import pack_body, unpack_arrays
from tests.benchmarks.stability.function import Function, Inputs, unit, weights

_STEPS = 2.0 / 65535  # a quantised value is within half a step of 1/32767 of the largest


@cache
def _body() -> BodyModel:
    return embedded_body()


def _rows(size: float, random: np.random.Generator) -> Inputs:
    return {"values": size * unit(random, 40)}


def _through_a_file(a: dict[str, Any]) -> np.ndarray:
    data = bytearray(b"".join(encode_arrays(a, "values.safetensors")))
    return decode_arrays(data, Path("values.safetensors"))[0]["values"]


def _as_tensor_of_a_bundle(a: dict[str, Any]) -> np.ndarray:
    """A tensor that may have 16 bits, through the file and back."""
    return _through_a_file_as("model/values", a["values"])


def _as_skin_weights(a: dict[str, Any]) -> np.ndarray:
    """Skinning weights, whose rows sum to one again."""
    return _through_a_file_as("maps/skin_weights", a["values"])


def _through_a_file_as(name: str, values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        narrow = halved({name: values.astype(np.float32)})
    data = bytearray(b"".join(encode_arrays(narrow, "bundle.gwg")))
    return whole(decode_arrays(data, Path("bundle.gwg"))[0])[name]


def _weights(smallest: float, random: np.random.Generator) -> Inputs:
    """Rows that sum to one, with one weight as small as asked."""
    values = weights(random, 40)
    values[:, 54] = smallest
    return {"values": values / values.sum(axis=1, keepdims=True)}


def _vertices(size: float, random: np.random.Generator) -> Inputs:
    return {"template_vertices": size * _body().template_vertices.astype(np.float64)}


def _packed(a: dict[str, Any]) -> np.ndarray:
    """Template vertices of a body model that was packed and unpacked."""
    vertices = a["template_vertices"].astype(np.float32)
    return unpack_arrays(pack_body(replace(_body(), template_vertices=vertices)), "packed").template_vertices


BUNDLES = (
    Function(
        "arrays on disk", "bundles", "value", (0.0, 1e-300, 1e-45, 1e-9, 1.0, 1e9, 1e38, 1e300), _rows,
        _through_a_file, everyday=(1e-9, 1e9), tolerance=1e-7, numpy=True,
    ),
    Function(
        "16-bit tensor", "bundles", "value", (0.0, 1e-45, 1e-9, 1e-4, 1e-3, 1.0, 1e3, 5e4, 1e5, 1e38, 1e300),
        _rows, _as_tensor_of_a_bundle, everyday=(1e-9, 1e38), tolerance=2.0**-11, numpy=True,
        truth=lambda a: a["values"],
    ),
    Function(
        "16-bit skin weights", "bundles", "smallest weight", (0.0, 1e-30, 1e-8, 1e-4, 0.25, 1.0, 1e3),
        _weights, _as_skin_weights, everyday=(0.0, 1.0), tolerance=2.0**-10, numpy=True,
        truth=lambda a: a["values"],
    ),
    Function(
        "pack_body", "bundles", "size of the body, m", (0.0, 1e-30, 1e-3, 1.0, 1e3, 1e30), _vertices, _packed,
        everyday=(1e-3, 1e3), tolerance=_STEPS, numpy=True,
        truth=lambda a: a["template_vertices"],
    ),
)  # fmt: skip

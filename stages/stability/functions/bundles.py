"""What numbers become on disk: exact in artifacts, 16-bit steps in packed body models."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from stages.shared.artifacts.arrays import decode_arrays, encode_arrays
from stages.shared.body import BodyModel, embedded_body
from stages.shared.body.packed import pack_body, unpack_arrays
from stages.stability.function import Function, Inputs, unit

_STEPS = 2.0 / 65535  # a quantised value is within half a step of 1/32767 of the largest


@cache
def _body() -> BodyModel:
    return embedded_body()


def _rows(size: float, random: np.random.Generator) -> Inputs:
    return {"values": size * unit(random, 40)}


def _through_a_file(a: dict[str, Any]) -> np.ndarray:
    data = bytearray(b"".join(encode_arrays(a, "values.safetensors")))
    return decode_arrays(data, Path("values.safetensors"))[0]["values"]


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
        "pack_body", "bundles", "size of the body, m", (0.0, 1e-30, 1e-3, 1.0, 1e3, 1e30), _vertices, _packed,
        everyday=(1e-3, 1e3), tolerance=_STEPS, numpy=True,
        truth=lambda a: a["template_vertices"],
    ),
)  # fmt: skip

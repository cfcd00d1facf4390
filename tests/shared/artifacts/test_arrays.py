"""Our safetensors against the library's, and every way a header can lie."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from stages.shared.artifacts.arrays import MAX_HEADER_BYTES, decode_arrays, encode_arrays
from stages.shared.errors import BadData

WHERE = Path("sample.safetensors")
DTYPES = ["f8", "f4", "f2", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1", "?"]


def sample() -> dict[str, np.ndarray]:
    random = np.random.default_rng(3)
    arrays = {dtype: (random.random((3, 5)) * 100).astype(dtype) for dtype in DTYPES}
    return arrays | {
        "scalar": np.array(2.5),
        "big endian": np.arange(4, dtype=">i4"),
        "empty": np.zeros((0, 2), "i4"),
    }


def encoded(arrays: dict[str, Any]) -> bytearray:
    return bytearray(b"".join(encode_arrays(arrays, "sample")))


def test_round_trip_keeps_values_types_and_shapes() -> None:
    arrays = sample()
    decoded, _ = decode_arrays(encoded(arrays), WHERE)
    assert set(decoded) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(decoded[name], array)
        assert decoded[name].shape == array.shape and decoded[name].dtype == array.dtype.newbyteorder("=")
        assert decoded[name].flags.writeable and decoded[name].flags.aligned


def test_the_safetensors_library_reads_what_we_write() -> None:
    arrays = sample()
    decoded = safetensors.numpy.load(bytes(encoded(arrays)))
    for name, array in arrays.items():
        np.testing.assert_array_equal(decoded[name], array)


def test_we_read_what_the_safetensors_library_writes() -> None:
    arrays = {name: np.ascontiguousarray(array) for name, array in sample().items() if name != "big endian"}
    decoded, notes = decode_arrays(bytearray(safetensors.numpy.save(arrays, {"made by": "library"})), WHERE)
    assert notes == {"made by": "library"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(decoded[name], array)


def test_bytes_do_not_depend_on_order_or_memory_layout() -> None:
    arrays = sample()
    turned = {name: arrays[name].copy(order="F") for name in reversed(arrays)}
    assert encoded(arrays) == encoded(turned)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
def test_values_that_are_not_finite_are_refused_by_name_and_index(value: float, dtype: str) -> None:
    vertices = np.zeros((4, 3), dtype)
    vertices[2, 1] = value
    with pytest.raises(BadData, match=r"index \[2, 1\]") as caught:
        encode_arrays({"vertices": vertices}, "template.safetensors")
    assert caught.value.where == "template.safetensors, array 'vertices'"


@pytest.mark.parametrize("value", [np.array(["text"]), np.array([object()]), np.zeros(2, "c8")])
def test_types_without_a_place_in_the_file_are_refused(value: np.ndarray) -> None:
    with pytest.raises(BadData, match="cannot be stored"):
        encode_arrays({"wrong": value}, "sample")


def lie(header: Any, data: bytes = bytes(24)) -> bytearray:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return bytearray(struct.pack("<Q", len(text)) + text + data)


def entry(**changes: Any) -> dict[str, Any]:
    return {"x": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]} | changes}


LIES = {
    "empty file": bytearray(),
    "short length": bytearray(b"\x01\x02"),
    "header longer than the file": bytearray(struct.pack("<Q", 100) + b"{}"),
    "header of 2^63 bytes": bytearray(struct.pack("<Q", 1 << 63) + b"{}"),
    "header above the limit": lie(b"{}" + b" " * MAX_HEADER_BYTES),
    "header is no JSON": lie(b"{"),
    "header is no UTF-8": lie(b"\xff\xfe"),
    "header is a list": lie([]),
    "header is very deep": lie(b"[" * 100_000),
    "name twice": lie(b'{"x":{"dtype":"U8","shape":[24],"data_offsets":[0,24]},"x":{}}'),
    "notes are numbers": lie({"__metadata__": {"a": 1}} | entry()),
    "entry is a number": lie({"x": 3}),
    "entry with more": lie(entry(more=1)),
    "unknown type": lie(entry(dtype="F8_E5M2")),
    "type is a list": lie(entry(dtype=[])),
    "shape does not fill": lie(entry(shape=[2, 4])),
    "shape is negative": lie(entry(shape=[-2, -3])),
    "shape overflows": lie(entry(shape=[1 << 32, 1 << 32])),
    "shape is true": lie(entry(shape=[True, 6])),
    "shape is a float": lie(entry(shape=[2.0, 3])),
    "shape is NaN": lie(b'{"x":{"dtype":"F32","shape":[NaN],"data_offsets":[0,24]}}'),
    "rank above 8": lie(entry(shape=[1] * 8 + [6])),
    "offsets reversed": lie(entry(data_offsets=[24, 0])),
    "offsets beyond the file": lie(entry(data_offsets=[24, 48])),
    "offsets are three": lie(entry(data_offsets=[0, 12, 24])),
    "hole before": lie(entry(shape=[1], data_offsets=[20, 24])),
    "data behind": lie(entry(shape=[1], data_offsets=[0, 4])),
    "truncated": lie(entry(), bytes(23)),
    "overlap": lie(entry() | {"y": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}}),
    "truth value 2": lie({"x": {"dtype": "BOOL", "shape": [24], "data_offsets": [0, 24]}}, b"\x02" * 24),
}


@pytest.mark.parametrize("name", LIES)
def test_a_lying_file_is_refused_by_name(name: str) -> None:
    with pytest.raises(BadData) as caught:
        decode_arrays(LIES[name], WHERE)
    assert str(WHERE) in caught.value.where


def test_mutated_files_are_read_whole_or_refused() -> None:
    original = encoded(sample())
    random = np.random.default_rng(11)
    refused = 0
    for _ in range(600):
        data = bytearray(original)
        for _ in range(random.integers(1, 4)):
            kind, place = random.integers(3), int(random.integers(len(data)))
            if kind == 0:
                data[place] ^= 1 << int(random.integers(8))
            elif kind == 1:
                del data[place : place + int(random.integers(1, 9))]
            else:
                data[place:place] = random.bytes(int(random.integers(1, 9)))
        try:
            arrays, _ = decode_arrays(data, WHERE)
        except BadData:
            refused += 1
        else:
            assert sum(array.nbytes for array in arrays.values()) <= len(data)
    assert 300 < refused < 600

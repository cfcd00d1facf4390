"""Bundles from strangers: each gives a valid object or one clean error, quickly, and touches nothing."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared.artifacts.bundle import SCHEMA, Bundle, decode_bundle, encode_bundle, read_bundle
from stages.shared.errors import BadData
from tests.hostile.forge import forged_parts
from tests.shared.outfit.wardrobe import bundle, worn

Header = dict[str, Any]


@pytest.fixture(scope="module")
def good() -> Bundle:
    return bundle(worn("upper"))


@pytest.fixture(scope="module")
def content(good: Bundle) -> bytes:
    return b"".join(encode_bundle(good))


def _parts(content: bytes) -> tuple[Header, bytes]:
    (length,) = struct.unpack_from("<Q", content)
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def _joined(header: Header | bytes, data: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<Q", len(text)) + text + data


def _refused(data: bytes, path: Path) -> str:
    path.write_bytes(data)
    with pytest.raises(BadData) as caught:
        read_bundle(path)
    assert str(path) in caught.value.where
    return caught.value.what


def test_the_forger_makes_good_bundles_too(good: Bundle, content: bytes) -> None:
    assert forged_parts(good.arrays, good.manifest) == content


def test_truncated_anywhere(content: bytes, tmp_path: Path) -> None:
    header = 8 + struct.unpack_from("<Q", content)[0]
    cuts = [0, 1, 7, 8, 9, header - 1, header, header + 1, len(content) // 2, len(content) - 1]
    for cut in cuts:
        _refused(content[:cut], tmp_path / "x.gwg")
    _refused(content + b"\0", tmp_path / "x.gwg")


def test_header_lengths(content: bytes, tmp_path: Path) -> None:
    for length in (0, 1, 2**20 + 1, 2**31, 2**62, 2**64 - 1):
        _refused(struct.pack("<Q", length) + content[8:], tmp_path / "x.gwg")


def test_headers_that_are_not_one(content: bytes, tmp_path: Path) -> None:
    _, data = _parts(content)
    deep = b"[" * 100_000 + b"]" * 100_000
    for header in (b"", b"null", b"[]", b"{", b'{"a":NaN}', b"\xff\xfe", deep, b'{"__metadata__":3}', b"{}"):
        _refused(_joined(header, data), tmp_path / "x.gwg")


def test_duplicate_names(content: bytes, tmp_path: Path) -> None:
    (length,) = struct.unpack_from("<Q", content)
    text = content[8 : 8 + length].rstrip()
    entry = b'"preview":' + json.dumps(_parts(content)[0]["preview"]).encode()
    assert "twice" in _refused(
        _joined(text[:-1] + b"," + entry + b"}", content[8 + length :]), tmp_path / "x.gwg"
    )


TensorChange = Callable[[Header], None]
TENSOR_LIES: dict[str, TensorChange] = {
    "shape with 2^62": lambda h: h["preview"].update(shape=[2**62, 8, 3]),
    "huge product": lambda h: h["preview"].update(shape=[2**24, 2**24, 2**24]),
    "negative side": lambda h: h["preview"].update(shape=[-8, -8, 3]),
    "fractional side": lambda h: h["preview"].update(shape=[8.0, 8, 3]),
    "true as a side": lambda h: h["preview"].update(shape=[True, 64, 3]),
    "rank 6": lambda h: h["preview"].update(shape=[1, 1, 1, 8, 8, 3]),
    "shape is a text": lambda h: h["preview"].update(shape="8"),
    "too short": lambda h: h["preview"].update(shape=[8, 8, 2]),
    "offsets backwards": lambda h: h["preview"].update(data_offsets=h["preview"]["data_offsets"][::-1]),
    "offsets outside": lambda h: h["preview"].update(data_offsets=[0, 2**40]),
    "offsets overlap": lambda h: h["preview"].update(data_offsets=[0, 192]),
    "offsets missing": lambda h: h["preview"].pop("data_offsets"),
    "offsets as texts": lambda h: h["preview"].update(data_offsets=["0", "192"]),
    "type F64": lambda h: h["preview"].update(dtype="F64"),
    "type unknown": lambda h: h["preview"].update(dtype="OBJECT"),
    "type a list": lambda h: h["preview"].update(dtype=["U8"]),
    "type I8 for U8": lambda h: h["preview"].update(dtype="I8"),
    "extra field": lambda h: h["preview"].update(code="print()"),
    "name with a path": lambda h: h.update({"../../etc/passwd": h.pop("preview")}),
    "unknown name": lambda h: h.update({"maps/preview": h.pop("preview")}),
    "tensor left out": lambda h: h.pop("preview"),
    "tensor is a number": lambda h: h.update(preview=3),
    "metadata left out": lambda h: h.pop("__metadata__"),
    "manifest is a number": lambda h: h["__metadata__"].update(gwg=3),
    "further metadata": lambda h: h["__metadata__"].update(more="x"),
    "seal wrong": lambda h: h["__metadata__"].update(gwg_sha256="0" * 64),
    "seal left out": lambda h: h["__metadata__"].pop("gwg_sha256"),
    "names swapped": lambda h: h.update(
        {"maps/normals": h["maps/positions"], "maps/positions": h["maps/normals"]}
    ),
    "2000 tensors": lambda h: h.update({f"model/t{k}": h["preview"] for k in range(2000)}),
}


@pytest.mark.parametrize("case", TENSOR_LIES)
def test_header_entries_that_lie(case: str, content: bytes, tmp_path: Path) -> None:
    header, data = _parts(content)
    TENSOR_LIES[case](header)
    _refused(_joined(header, data), tmp_path / "x.gwg")


def _set(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda manifest: manifest.update({name: value})


MANIFEST_LIES: dict[str, Callable[[dict[str, Any]], None]] = {
    "newer major": _set("schema", {"name": "gwg", "major": 2, "minor": 0}),
    "other format": _set("schema", {"name": "zip", "major": 1, "minor": 0}),
    "version as text": _set("schema", {"name": "gwg", "major": "1", "minor": 0}),
    "kind unknown": _set("kind", "hat"),
    "kind and layer differ": _set("kind", "body"),
    "layer unknown": _set("layer", "hat"),
    "no slots": _set("slots", []),
    "foreign slots": _set("slots", ["lower"]),
    "slots twice": _set("slots", ["upper", "upper"]),
    "slots as text": _set("slots", "upper"),
    "no digest": _set("body_model", {"joints": 55, "betas": 10}),
    "digest as path": _set("body_model", {"digest": "../" * 21 + "x", "joints": 55, "betas": 10}),
    "24 joints": _set("body_model", {"digest": "ab" * 32, "joints": 24, "betas": 10}),
    "pitch zero": _set("grid", {"pitch": 0, "centre": [0, 0, 0], "size": 100}),
    "pitch true": _set("grid", {"pitch": True, "centre": [0, 0, 0], "size": 100}),
    "grid of a billion": _set("grid", {"pitch": 0.02, "centre": [0, 0, 0], "size": 10**9}),
    "centre far away": _set("grid", {"pitch": 0.02, "centre": [0, 0, 99], "size": 100}),
    "centre with four": _set("grid", {"pitch": 0.02, "centre": [0, 0, 0, 0], "size": 100}),
    "note is a list": _set("note", []),
    "note too long": _set("note", "x" * 5000),
    "note is a path": _set("note", "/home/someone/secret"),
    "model is a text": _set("model", "x"),
    "too deep": _set("units", json.loads('{"a":' * 30 + "1" + "}" * 30)),
}


@pytest.mark.parametrize("case", MANIFEST_LIES)
def test_manifests_that_lie_though_sealed(case: str, good: Bundle, tmp_path: Path) -> None:
    manifest = dict(good.manifest)
    MANIFEST_LIES[case](manifest)
    what = _refused(forged_parts(good.arrays, manifest), tmp_path / "x.gwg")
    if case == "newer major":
        assert "2.0" in what and f"{SCHEMA['major']}.{SCHEMA['minor']}" in what


ArrayChange = Callable[[np.ndarray], np.ndarray]


def _with(index: Any, value: float) -> ArrayChange:
    def changed(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[index] = value
        return array

    return changed


ARRAY_LIES: list[tuple[str, ArrayChange]] = [
    ("maps/positions", _with((0, 0), 3.0)),
    ("maps/positions", lambda a: a[:-1]),
    ("maps/positions", lambda a: a.astype(np.float16)),
    ("maps/normals", _with(0, 0.0)),
    ("maps/normals", lambda a: a * 2),
    ("maps/skin_weights", _with((3, 0), 0.5)),
    ("maps/skin_weights", lambda a: -a),
    ("maps/skin_weights", lambda a: a[:, :24]),
    ("maps/shape_directions", lambda a: a + 2),
    ("maps/neighbours", _with((0, 0), 10**6)),
    ("maps/neighbours", _with((0, 0), -2)),
    ("maps/seams", _with((0, 0), 10**6)),
    ("maps/seams", lambda a: a[:, :1]),
    ("maps/texels", _with((0, 0), 2)),
    ("maps/texels", _with((0, 1), -1)),
    ("maps/texels", lambda a: a[::-1]),
    ("maps/texels", lambda a: np.repeat(a[:1], len(a), 0)),
    ("maps/window", lambda a: a * 0),
    ("maps/window", lambda a: a + 10_000),
    ("maps/window", lambda a: a[:3]),
    ("maps/spacing", lambda a: a * 0),
    ("maps/spacing", lambda a: a + 2),
    ("maps/colors", lambda a: a + 2),
    ("maps/color_confidence", lambda a: a - 3),
    ("betas", lambda a: a + 100),
    ("betas", lambda a: a[:5]),
    ("preview", lambda a: a[..., 0]),
    ("preview", lambda a: np.zeros((4096, 8, 3), np.uint8)),
    ("swap/offsets", lambda a: a + 5),
    ("swap/quaternions", lambda a: a * 0),
    ("swap/quaternions", lambda a: a[:-1]),
    ("swap/texels", lambda a: a + 1000),
    ("model/base_offset", lambda a: a * 0 + 1e9),
]


@pytest.mark.parametrize("case", range(len(ARRAY_LIES)), ids=lambda k: f"{ARRAY_LIES[k][0]}-{k}")
def test_arrays_that_mean_nothing_though_sealed(case: int, good: Bundle, tmp_path: Path) -> None:
    name, change = ARRAY_LIES[case]
    arrays = {**good.arrays, name: np.ascontiguousarray(change(good.arrays[name]))}
    _refused(forged_parts(arrays, good.manifest), tmp_path / "x.gwg")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(value: float, content: bytes, tmp_path: Path) -> None:
    """`encode_arrays` refuses to write them, so they are put into the bytes, and the seal is renewed."""
    header, data = _parts(content)
    spot = header["maps/colors"]["data_offsets"][0]
    changed = data[:spot] + struct.pack("<f", value) + data[spot + 4 :]
    _refused(_joined(content[8 : 8 + struct.unpack_from("<Q", content)[0]], changed), tmp_path / "x.gwg")


def test_a_garment_may_not_bring_a_body(good: Bundle, tmp_path: Path) -> None:
    arrays = {**good.arrays, "body/template_vertices": np.zeros((4, 3), np.float32)}
    _refused(forged_parts(arrays, good.manifest), tmp_path / "x.gwg")


def test_every_flipped_bit_is_found(content: bytes) -> None:
    random = np.random.default_rng(0)
    (length,) = struct.unpack_from("<Q", content)
    spots = np.concatenate([random.integers(0, 8 + length, 150), random.integers(0, len(content), 250)])
    for spot, bit in zip(spots, random.integers(0, 8, len(spots)), strict=True):
        data = bytearray(content)
        data[spot] ^= 1 << bit
        with pytest.raises(BadData):
            decode_bundle(data, "flipped.gwg")


def test_files_too_large_are_not_read(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.gwg"
    path.write_bytes(content)
    with pytest.raises(BadData, match="more than 1000"):
        read_bundle(path, max_bytes=1000)


_events: list[str] = []
_armed = False


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not _armed:
        return
    writing = event == "open" and isinstance(arguments[1], str) and any(c in arguments[1] for c in "wax+")
    if (
        writing
        or event.split(".")[0] in ("socket", "subprocess")
        or event in ("os.system", "exec", "os.exec")
    ):
        _events.append(event)


def test_reading_starts_and_writes_nothing(content: bytes, tmp_path: Path) -> None:
    """An audit hook sees no process, no socket, no code and no file opened for writing."""
    global _armed
    path = tmp_path / "x.gwg"
    header, data = _parts(content)
    sys.addaudithook(_watch)
    for change in (lambda h: None, *TENSOR_LIES.values()):
        forged = json.loads(json.dumps(header))
        change(forged)
        path.write_bytes(_joined(forged, data))
        _armed = True
        try:
            read_bundle(path)
        except BadData:
            pass
        finally:
            _armed = False
    assert _events == []

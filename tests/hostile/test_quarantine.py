"""Pickles that try something: refused, all of them, and nothing happens."""

from __future__ import annotations

import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared.capture.pickles import PickleReader
from stages.shared.errors import BadData, GwError

MARK = "touched"


class Calls:
    """Pickles to a call of any function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.function, self.arguments


class State:
    def __reduce__(self) -> tuple[Any, ...]:
        return (np.ndarray, ((0,),), {"__setstate__": os.system})


def opcode(*parts: bytes) -> bytes:
    return b"\x80\x04" + b"".join(parts) + b"."


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def array_with(shape: tuple[int, ...], kind: str, data: bytes) -> bytes:
    """The pickle of an array with any claim about itself."""
    good = pickle.dumps(np.zeros(1, np.float64), protocol=2)
    assert b"K\x01\x85" in good
    return pickle.dumps(_Claim(shape, kind, data), protocol=2)


class _Claim:
    def __init__(self, shape: tuple[int, ...], kind: str, data: bytes) -> None:
        self.claim = (1, shape, np.dtype(kind), False, data)

    def __reduce__(self) -> tuple[Any, ...]:
        reconstruct, arguments, _ = np.zeros(1).__reduce__()[:3]
        return reconstruct, arguments, self.claim


def nested(depth: int) -> bytes:
    return b"\x80\x04" + b"]" * depth + b"a" * (depth - 1) + b"."


def payloads(mark: Path) -> dict[str, bytes]:
    touch = f"touch {mark}"
    bomb: Any = [0] * 10
    for _ in range(12):
        bomb = [bomb] * 10
    loop: list[Any] = []
    loop.append(loop)
    ring: dict[str, Any] = {}
    ring["again"] = ring
    return {
        "system": pickle.dumps(Calls(os.system, touch)),
        "eval": pickle.dumps(Calls(eval, f"open({str(mark)!r}, 'w')")),
        "exec": pickle.dumps(Calls(exec, f"open({str(mark)!r}, 'w')")),
        "open": pickle.dumps(Calls(open, str(mark), "w")),
        "popen": pickle.dumps(Calls(__import__("subprocess").Popen, ["touch", str(mark)])),
        "attribute chain": opcode(text("os"), text("path.os.system"), b"\x93", text(touch), b"\x85R"),
        "getattr": pickle.dumps(Calls(getattr, "text", "format")),
        "partial": pickle.dumps(__import__("functools").partial(os.system, touch)),
        "import": pickle.dumps(Calls(__import__, "this")),
        "setstate": pickle.dumps(State()),
        "old class": b"(S'" + touch.encode() + b"'\nios\nsystem\n.",
        "global": b"cos\nsystem\n(S'" + touch.encode() + b"'\ntR.",
        "extension code": b"\x80\x02\x82\x01.",
        "persistent id": b"Phere\n.",
        "binary persistent id": opcode(text("here"), b"Q"),
        "memo trick": b"\x80\x04cos\nsystem\nq\x000h\x00(S'" + touch.encode() + b"'\ntR.",
        "memo out of range": b"\x80\x04h\x63.",
        "numpy load": pickle.dumps(Calls(np.load, str(mark))),
        "numpy other name": b"cnumpy\nmemmap\n(S'" + str(mark).encode() + b"'\ntR.",
        "object array": pickle.dumps(np.array([{}, None], dtype=object)),
        "record array": pickle.dumps(np.zeros(2, dtype=[("a", "f4")])),
        "text array": pickle.dumps(np.array(["a", "bc"])),
        "big-endian array": pickle.dumps(np.zeros(3, ">f8")),
        "too much claimed": array_with((10, 1 << 30), "<f8", b"\0" * 8),
        "negative side": array_with((-1, 8), "<f8", b"\0" * 8),
        "too little data": array_with((3,), "<f8", b"\0" * 16),
        "too much data": array_with((1,), "<f8", b"\0" * 16),
        "attributes on a stand-in": b"\x80\x02cnumpy\ndtype\n}X\x08\x00\x00\x00__call__K\x01sb.",
        "new object": b"\x80\x02cnumpy\nndarray\n)\x81.",
        "class as value": b"\x80\x02cnumpy\nndarray\n.",
        "deep nesting": nested(5000),
        "very deep nesting": nested(2_000_000),
        "many from few": pickle.dumps(bomb),
        "list in itself": pickle.dumps(loop),
        "dictionary in itself": pickle.dumps(ring),
        "set": pickle.dumps({1, 2}),
        "complex": pickle.dumps(1j),
        "bytes": pickle.dumps(b"abc"),
        "huge number": pickle.dumps(1 << 90),
        "long text": pickle.dumps("x" * 10_000),
        "claimed bytes": b"\x80\x04\x8e" + struct.pack("<Q", 10 << 30) + b".",
        "claimed bytearray": b"\x80\x05\x96" + struct.pack("<Q", 3 << 30) + b".",
        "claimed memo": b"\x80\x04]r" + struct.pack("<I", 0x7FFFFFFF) + b".",
        "wrong encode": pickle.dumps(Calls(__import__("_codecs").encode, "abc", "rot13")),
        "empty": b"",
        "no pickle": b"hello, this is text",
        "cut short": pickle.dumps({"a": np.zeros(100)})[:-50],
        "protocol 99": b"\x80\x63N.",
    }


NAMES = list(payloads(Path("x")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("payloads")
    for number, data in enumerate(payloads(path / MARK).values()):
        (path / f"{number}.pkl").write_bytes(data)
    return path


@pytest.fixture(scope="module")
def reader() -> Any:
    with PickleReader(seconds=60) as reader:
        yield reader


@pytest.mark.parametrize("name", NAMES)
def test_payload_is_refused(folder: Path, name: str) -> None:
    path = folder / f"{NAMES.index(name)}.pkl"
    with PickleReader(seconds=60) as one, pytest.raises(BadData) as caught:
        one.read(path)
    assert caught.value.where == str(path) and caught.value.exit_code == 65
    assert not (folder / MARK).exists()


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_comes_through(tmp_path: Path, reader: PickleReader, protocol: int) -> None:
    random = np.random.default_rng(protocol)
    value = {
        "vertices": random.normal(size=(5, 3)),
        "faces": random.integers(0, 5, (4, 3)),
        "column major": np.asfortranarray(random.normal(size=(4, 3, 2)).astype(np.float32)),
        "view": random.normal(size=(6, 6))[::2, 1:4],
        "flags": np.array([True, False]),
        "scalar": np.float32(1.5),
        "nothing": None,
        "empty": np.zeros((0, 3)),
        "frames": ["00011", "00012"],
        "nested": [{"a": (1, 2.5, True)}, np.arange(3, dtype=np.uint8)],
        7: "number as key",
    }
    (tmp_path / "v.pkl").write_bytes(pickle.dumps(value, protocol=protocol))
    found = reader.read(tmp_path / "v.pkl")
    for key in ("vertices", "faces", "column major", "view", "flags", "empty"):
        np.testing.assert_array_equal(found[key], value[key], err_msg=key)
        assert found[key].dtype == value[key].dtype
    assert found["scalar"] == 1.5 and found["nothing"] is None and found["frames"] == ["00011", "00012"]
    assert found["nested"][0] == {"a": [1, 2.5, True]} and found["7"] == "number as key"
    np.testing.assert_array_equal(found["nested"][1], [0, 1, 2])


def test_numbers_that_are_not_finite_keep_their_place_or_are_dropped(
    tmp_path: Path, reader: PickleReader
) -> None:
    (tmp_path / "v.pkl").write_bytes(pickle.dumps({"a": np.array([np.nan, 1.0]), "b": float("nan")}))
    found = reader.read(tmp_path / "v.pkl")
    assert found["b"] is None and np.isnan(found["a"][0])


def test_a_slow_file_is_stopped(tmp_path: Path) -> None:
    """Millions of operations: ended by the clock, not by patience."""
    (tmp_path / "slow.pkl").write_bytes(b"\x80\x04" + b"N0" * 60_000_000 + b"N.")
    with PickleReader(seconds=0.2) as reader, pytest.raises(BadData, match="too long"):
        reader.read(tmp_path / "slow.pkl")


def test_the_child_ends_with_its_block(tmp_path: Path) -> None:
    with PickleReader() as reader:
        child = reader._child
        assert child.poll() is None
    assert child.poll() is not None


def test_absent_file(tmp_path: Path, reader: PickleReader) -> None:
    with pytest.raises(GwError) as caught:
        reader.read(tmp_path / "none.pkl")
    assert caught.value.exit_code == 66


def test_fuzzed_pickles_give_a_value_or_an_error(tmp_path: Path) -> None:
    good = pickle.dumps({"a": np.arange(6.0).reshape(2, 3), "b": ["x", 1, None]}, protocol=4)
    random = np.random.default_rng(0)
    path = tmp_path / "f.pkl"
    refused = 0
    reader = PickleReader(seconds=20)
    for _ in range(300):
        data = bytearray(good)
        for _ in range(random.integers(1, 5)):
            data[random.integers(len(data))] = random.integers(256)
        path.write_bytes(data[: random.integers(len(data) // 2, len(data) + 1)])
        try:
            reader.read(path)
        except BadData:
            refused += 1
            if reader._child.poll() is not None:
                reader.__exit__(None, None, None)
                reader = PickleReader(seconds=20)
    reader.__exit__(None, None, None)
    assert refused > 100

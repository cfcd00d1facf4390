"""Bundles mutated by chance: each is a valid object or one clean error, in few calls and little memory.

An audit hook watches every reading: no process, no socket, no code, no file opened for writing.
"""

from __future__ import annotations

import copy
import itertools
import json
import os
import resource
import struct
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.shared.artifacts.arrays import encode_arrays
from stages.shared.artifacts.bundle import SCHEMA, Bundle, decode_bundle, read_bundle, read_card
from stages.shared.artifacts.canonical import canonical_json, digest
from stages.shared.errors import GwError

GOLDEN = Path(__file__).parents[1] / "golden"
FILES = ("garment-f16-1.1.gwg", "body-1.1.gwg", "garment-cloth-1.2.gwg")
COUNT = 320
CALLS, BYTES = 60_000, 256 << 20
NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2**31, 2**62, 2**63, 2**64, 1e308, -0.0, 0.5, True, None, "", "x" * 5000, [], {}, [[[[]]]],
    "../../../etc/passwd", "\x00", {"a": {"b": {}}}, [2**62, 2**62], "NaN", 10**400,
)  # fmt: skip

Mutation = Callable[[bytes, np.random.Generator], bytes]


def _parts(content: bytes) -> tuple[bytes, bytes]:
    (length,) = struct.unpack_from("<Q", content)
    return content[8 : 8 + length], content[8 + length :]


def _joined(header: bytes, data: bytes) -> bytes:
    return struct.pack("<Q", len(header)) + header + data


def _spot(container: Any, random: np.random.Generator) -> tuple[Any, Any]:
    """A place in a JSON tree, any depth: the container and the key."""
    while True:
        keys = list(container) if isinstance(container, dict) else list(range(len(container)))
        key = keys[random.integers(len(keys))]
        inside = container[key]
        if not isinstance(inside, dict | list) or not inside or random.random() < 0.3:
            return container, key
        container = inside


def _changed_tree(tree: Any, random: np.random.Generator) -> Any:
    tree = json.loads(json.dumps(tree))
    for _ in range(random.integers(1, 4)):
        if not tree:
            break
        container, key = _spot(tree, random)
        if isinstance(container, dict) and random.random() < 0.2:
            container.pop(key)
        else:
            container[key] = copy.deepcopy(NUMBERS[random.integers(len(NUMBERS))])
    return tree


def truncated(content: bytes, random: np.random.Generator) -> bytes:
    return content[: random.integers(len(content))]


def flipped(content: bytes, random: np.random.Generator) -> bytes:
    data = bytearray(content)
    for _ in range(random.integers(1, 9)):
        data[random.integers(len(data))] ^= 1 << random.integers(8)
    return bytes(data)


def scrambled_header(content: bytes, random: np.random.Generator) -> bytes:
    header, data = _parts(content)
    changed = bytearray(header)
    start = random.integers(len(changed))
    changed[start : start + random.integers(1, 40)] = random.bytes(random.integers(0, 40))
    return _joined(bytes(changed), data)


def lying_header(content: bytes, random: np.random.Generator) -> bytes:
    header, data = _parts(content)
    return _joined(json.dumps(_changed_tree(json.loads(header), random)).encode(), data)


def header_length(content: bytes, random: np.random.Generator) -> bytes:
    return struct.pack("<Q", int(random.integers(0, 2**63)) >> int(random.integers(0, 63))) + content[8:]


def deep(content: bytes, random: np.random.Generator) -> bytes:
    levels = int(random.integers(10, 100_000))
    text = b'{"a":' * levels + b"1" + b"}" * levels
    return _joined(text[: 1 << 20], _parts(content)[1])


def overlapping(content: bytes, random: np.random.Generator) -> bytes:
    header, data = _parts(content)
    entries = json.loads(header)
    names = [name for name in entries if name != "__metadata__"]
    one, other = (names[k] for k in random.choice(len(names), 2, replace=False))
    entries[one]["data_offsets"] = entries[other]["data_offsets"]
    return _joined(json.dumps(entries).encode(), data)


def spliced(content: bytes, random: np.random.Generator) -> bytes:
    first, second = sorted(random.integers(0, len(content), 2))
    return content[:first] + random.bytes(int(random.integers(0, 200))) + content[second:]


def forged(content: bytes, random: np.random.Generator) -> bytes:
    """Right digests over wrong content: what only the check of meaning can find."""
    good = decode_bundle(bytearray(content), "good")
    manifest, arrays = dict(good.manifest), dict(good.arrays)
    if random.random() < 0.4:
        manifest = _changed_tree(manifest, random)
    else:
        name = list(arrays)[random.integers(len(arrays))]
        arrays[name] = _changed_array(arrays[name], random)
    return _sealed(Bundle(manifest, arrays))


def _changed_array(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    kind = random.integers(6)
    if kind == 0:
        return np.ascontiguousarray(array[: random.integers(len(array)) or 1])
    if kind == 1:
        return np.ascontiguousarray(array[..., None])
    if kind == 2 and array.dtype.kind == "f":
        return array.astype(np.float16 if array.dtype == np.float32 else np.float32)
    changed = array.copy()
    spots = random.integers(0, changed.size, random.integers(1, 20))
    if array.dtype.kind == "f":
        values = [1e4, -1e4, 0, 1e-30, -1, 3.0]
    else:
        values = [0, 255, 7] if array.dtype == np.uint8 else [0, -1, 2**31 - 1, -(2**31), 4096, 99]
    changed.reshape(-1)[spots] = values[random.integers(len(values))]
    return changed


def _sealed(bundle: Bundle) -> bytes:
    tensors = {}
    for name, array in bundle.arrays.items():
        mark = f"{array.dtype.newbyteorder('<').str} {list(array.shape)} ".encode()
        tensors[name] = {"sha256": digest(mark + array.tobytes())}
    manifest = {"schema": SCHEMA, **bundle.manifest, "tensors": tensors}
    try:
        text = canonical_json(manifest)
    except (ValueError, OverflowError, TypeError):  # what the mutation put there has no JSON
        text = b"{}"
    notes = {"gwg": text.decode(), "gwg_sha256": digest(text)}
    return b"".join(encode_arrays(bundle.arrays, "forged", notes))


MUTATIONS: tuple[Mutation, ...] = (
    truncated, flipped, scrambled_header, lying_header, header_length, deep, overlapping, spliced, forged,
    forged, forged,
)  # fmt: skip
_events: list[str] = []
_armed = False


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not _armed:
        return
    writing = False
    if event == "open":
        mode, flags = arguments[1], arguments[2]
        writing = (isinstance(mode, str) and any(letter in mode for letter in "wax+")) or (
            isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        )
    started = event.split(".")[0] in ("socket", "subprocess", "ctypes", "shutil")
    if (
        writing
        or started
        or event in ("os.system", "os.exec", "os.fork", "os.posix_spawn", "exec", "compile")
    ):
        _events.append(f"{event} {arguments[:1]}")


def _read(path: Path, reader: Callable[[Path], Any]) -> bool:
    """Whether a file was accepted; anything but a clean error fails the test."""
    global _armed
    calls = itertools.count()
    sys.setprofile(lambda frame, event, argument: event.endswith("call") and next(calls))
    _armed = True
    try:
        reader(path)
        accepted = True
    except GwError as error:
        accepted = False
        assert str(path) in error.where and error.exit_code == 65, error
        assert len(error.what) < 2000 and "\n" not in error.what
    finally:
        _armed = False
        sys.setprofile(None)
    count = next(calls)
    assert count < CALLS, count
    return accepted


def _peak_bytes() -> int:
    """The most memory that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _run(tmp_path: Path, count: int, seed: int) -> dict[str, int]:
    contents = [(GOLDEN / name).read_bytes() for name in FILES]
    random = np.random.default_rng(seed)
    path = tmp_path / "x.gwg"
    found = {"accepted": 0, "refused": 0}
    sys.addaudithook(_watch)
    for index in range(count):
        mutation = MUTATIONS[index % len(MUTATIONS)]
        path.write_bytes(mutation(contents[index % len(contents)], random))
        before = _peak_bytes()
        accepted = _read(path, read_bundle)
        good_header = _read(path, read_card)
        assert good_header or not accepted, "the header of a good bundle is good"
        assert _peak_bytes() - before < BYTES
        found["accepted" if accepted else "refused"] += 1
    assert _events == []
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["x.gwg"]
    return found


def test_a_small_file_is_read_in_little_memory(tmp_path: Path) -> None:
    """A read asks for what is there, not for what would be allowed."""
    contents = (GOLDEN / FILES[0]).read_bytes()
    path = tmp_path / "x.gwg"
    for content in (contents, contents[:-9], overlapping(contents, np.random.default_rng(0))):
        path.write_bytes(content)
        tracemalloc.start()
        _read(path, read_bundle)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20 * len(contents)


def test_mutated_bundles_are_refused_cleanly(tmp_path: Path) -> None:
    found = _run(tmp_path, COUNT, seed=1)
    # Some forgeries are harmless: other colours, another note. Damage never is.
    assert found["refused"] > 0.8 * COUNT


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 12))
def test_many_mutated_bundles_are_refused_cleanly(seed: int, tmp_path: Path) -> None:
    _run(tmp_path, 2000, seed)


def _flips(count: int) -> None:
    contents = [(GOLDEN / name).read_bytes() for name in FILES]
    random = np.random.default_rng(7)
    for index in range(count):
        data = bytearray(contents[index % len(contents)])
        data[random.integers(len(data))] ^= 1 << random.integers(8)
        with pytest.raises(GwError):
            decode_bundle(data, "flipped.gwg")


def test_single_flipped_bits_are_found() -> None:
    _flips(300)


@pytest.mark.long
def test_ten_thousand_single_flipped_bits_are_found() -> None:
    _flips(10_000)

"""The only program here that reads pickles: a child process that admits plain data alone.

Run by path (`python -I quarantine.py`) with an empty environment. It uses the standard library only, opens
no file, and speaks through its pipes: for every request on stdin (8 bytes length, then the pickle) one
answer on stdout (one byte 0 or 1, 8 bytes length, then a safetensors file or a reason for refusing).

No class named in a pickle is ever looked up. The few names that numpy's own pickles use are replaced by inert
stand-ins which collect shape, type and bytes; every other name ends the reading. After the set-up any
attempt to open, import, compile or start something ends the process (audit hook), and limits bound memory,
time and files.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import resource
import struct
import sys
from typing import Any, NoReturn

MEMORY_BYTES = 4 << 30
SECONDS = 600
MAX_DEPTH = 16
MAX_NODES = 200_000
MAX_TEXT = 4096
_KINDS = {
    "f8": "F64", "f4": "F32", "f2": "F16", "i8": "I64", "i4": "I32", "i2": "I16", "i1": "I8", "u8": "U64",
    "u4": "U32", "u2": "U16", "u1": "U8", "b1": "BOOL",
}  # fmt: skip
_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")


class Refused(Exception):
    """The pickle holds something other than plain data."""


class _Kind:
    """Stand-in for a numpy dtype."""

    __slots__ = ("code",)

    def __init__(self, code: str) -> None:
        self.code = code

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", "|", "="):
            raise Refused("an array with big-endian numbers")
        if any(part is not None for part in state[2:5]):
            raise Refused("an array of records")


class _Array:
    """Stand-in for a numpy array, filled in by its state."""

    __slots__ = ("code", "data", "fortran", "shape")

    def __init__(self) -> None:
        self.code, self.shape, self.data, self.fortran = "", (0,), b"", False

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise Refused("an array with an unknown state")
        _, shape, kind, fortran, data = state
        self.fill(shape, kind, data, bool(fortran))

    def fill(self, shape: Any, kind: Any, data: Any, fortran: bool) -> None:
        if not isinstance(kind, _Kind) or kind.code not in _KINDS:
            raise Refused("an array that does not hold plain numbers")
        whole = isinstance(shape, tuple) and len(shape) <= 5
        if not whole or not all(type(side) is int and 0 <= side < 1 << 32 for side in shape):
            raise Refused("an array with an impossible shape")
        if not isinstance(data, bytes | bytearray):
            raise Refused("an array of objects")
        size = int(kind.code[1])
        for side in shape:
            size *= side
        if size != len(data):
            raise Refused(f"an array whose shape needs {size} bytes and that has {len(data)}")
        self.code, self.shape, self.data, self.fortran = kind.code, shape, bytes(data), fortran


class _Name:
    """An inert object for a global name; subclasses may be called. It takes no attributes."""

    __slots__ = ()


class _ArrayClass(_Name):
    __slots__ = ()


class _Reconstruct(_Name):
    __slots__ = ()

    def __call__(self, kind: Any, shape: Any, code: Any) -> _Array:
        if not isinstance(kind, _ArrayClass):
            raise Refused("an array of an unknown class")
        return _Array()


class _DtypeClass(_Name):
    __slots__ = ()

    def __call__(self, code: Any, *flags: Any) -> _Kind:
        text = code.decode("ascii", "replace") if isinstance(code, bytes) else code
        if not isinstance(text, str) or not re.fullmatch(r"[<|=]?[fiub][1248]", text):
            raise Refused("an array that does not hold plain numbers")
        return _Kind(text.lstrip("<|="))


class _Scalar(_Name):
    __slots__ = ()

    def __call__(self, kind: Any, data: Any = b"") -> _Array:
        array = _Array()
        array.fill((), kind, data, False)
        return array


class _FromBuffer(_Name):
    __slots__ = ()

    def __call__(self, data: Any, kind: Any, shape: Any, order: Any, *more: Any) -> _Array:
        array = _Array()
        array.fill(shape, kind, data, order == "F")
        return array


class _Encode(_Name):
    __slots__ = ()

    def __call__(self, text: Any, codec: Any) -> bytes:
        if not isinstance(text, str) or codec not in ("latin1", "latin-1"):
            raise Refused("a text in an unknown code")
        return text.encode("latin-1")


class _Dictionary(_Name):
    __slots__ = ()

    def __call__(self, *content: Any) -> dict[Any, Any]:
        if content:
            raise Refused("a container with unknown content")
        return {}


class _EmptyBytes(_Name):
    """What old protocols write for bytes without content."""

    __slots__ = ()

    def __call__(self, *content: Any) -> bytes:
        if content:
            raise Refused("bytes made from something else")
        return b""


_NAMES: dict[tuple[str, str], _Name] = {
    **{(module, "_reconstruct"): _Reconstruct() for module in _MULTIARRAY},
    **{(module, "scalar"): _Scalar() for module in _MULTIARRAY},
    **{(module, "_frombuffer"): _FromBuffer() for module in _NUMERIC},
    ("numpy", "ndarray"): _ArrayClass(),
    ("trimesh.caching", "TrackedArray"): _ArrayClass(),  # an array with another name
    ("numpy", "dtype"): _DtypeClass(),
    ("_codecs", "encode"): _Encode(),
    ("collections", "OrderedDict"): _Dictionary(),
    ("__builtin__", "bytes"): _EmptyBytes(),
}


class PlainUnpickler(pickle.Unpickler):
    """An unpickler to which no name of any module is known."""

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in for a name, or an end."""
        try:
            return _NAMES[module, name]
        except KeyError:
            raise Refused(f"the name {module[:60]}.{name[:60]}, which is no plain data") from None

    def persistent_load(self, identity: Any) -> NoReturn:
        """References to elsewhere are not followed."""
        raise Refused("a reference to another object")


def encode(value: Any) -> bytes:
    """A safetensors file with all arrays in `value`; its metadata entry `tree` says where each one belongs.

    In the tree an array is {"array": name} and a container {"list": […]} or {"dict": {…}}; the rest is as it
    is.
    """
    arrays: list[_Array] = []
    left = [MAX_NODES]

    def describe(item: Any, depth: int) -> Any:
        left[0] -= 1
        if depth > MAX_DEPTH or left[0] < 0:
            raise Refused("a structure that is too deep, too large, or holds itself")
        if item is None or isinstance(item, bool):
            return item
        if type(item) is int and abs(item) < 1 << 63:
            return item
        if type(item) is float:
            return item if item - item == 0 else None
        if type(item) is str and len(item) <= MAX_TEXT:
            return item
        if isinstance(item, _Array):
            if not item.code:
                raise Refused("an array without content")
            arrays.append(item)
            return {"array": f"a{len(arrays) - 1}"}
        if isinstance(item, list | tuple):
            return {"list": [describe(part, depth + 1) for part in item]}
        if isinstance(item, dict):
            if not all(type(key) in (str, int) and len(str(key)) <= 200 for key in item):
                raise Refused("a dictionary whose keys are neither text nor whole numbers")
            return {"dict": {str(key): describe(part, depth + 1) for key, part in item.items()}}
        raise Refused("something that is neither a number, nor a text, nor an array, nor a container")

    tree = describe(value, 0)
    header: dict[str, Any] = {"__metadata__": {"tree": json.dumps(tree)}}
    place = 0
    for number, array in enumerate(arrays):
        # A column-major array is its transpose in row-major order; the name tells the reader to turn it back.
        shape = array.shape[::-1] if array.fortran else array.shape
        name = f"a{number}" + ("T" if array.fortran else "")
        end = place + len(array.data)
        header[name] = {"dtype": _KINDS[array.code], "shape": list(shape), "data_offsets": [place, end]}
        place = end
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + b"".join(array.data for array in arrays)


def convert(data: bytes) -> bytes:
    """Safetensors content of a pickle; Refused for anything that is not plain data."""
    try:
        stream = io.BytesIO(data)
        value = PlainUnpickler(stream).load()
    except Refused:
        raise
    except MemoryError:
        raise Refused("more than fits in memory") from None
    except Exception as error:  # a damaged pickle fails in every way there is
        raise Refused(f"something that cannot be read ({type(error).__name__})") from None
    return encode(value)


def confine() -> None:
    """Bound memory, time and files, and end the process at the first reach outside."""
    for limit, value in (
        (resource.RLIMIT_AS, MEMORY_BYTES),
        (resource.RLIMIT_CPU, SECONDS),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 3),
        (resource.RLIMIT_NPROC, 0),
    ):
        hard = resource.getrlimit(limit)[1]
        bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(limit, (bound, bound))
    forbidden = (
        "open",
        "import",
        "exec",
        "compile",
        "os.",
        "socket.",
        "subprocess.",
        "ctypes.",
        "shutil.",
        "mmap.",
    )

    def watch(event: str, _: Any) -> None:
        if event.startswith(forbidden):
            os._exit(77)

    sys.addaudithook(watch)


def main() -> None:
    """Answer requests until stdin ends."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    convert(pickle.dumps({"warm": [1.0, "text"]}))  # modules that load late are loaded before the hook is set
    confine()
    while True:
        opening = requests.read(8)
        if len(opening) < 8:
            return
        data = requests.read(struct.unpack("<Q", opening)[0])
        try:
            good, answer = b"\x00", convert(data)
        except Refused as error:
            good, answer = b"\x01", str(error).encode()[:400]
        except (MemoryError, RecursionError):
            good, answer = b"\x01", b"more than can be held"
        answers.write(good + struct.pack("<Q", len(answer)) + answer)
        answers.flush()


if __name__ == "__main__":
    main()

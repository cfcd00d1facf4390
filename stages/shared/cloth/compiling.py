"""How the cloth kernels are compiled.

numba keeps compiled code on disk and compiles again when the file of a kernel changes. Kernels here inline
one another across files, so the stamp is a digest of all of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_KERNEL_FILES = ("compiling.py", "contact.py", "kernels.py", "riding_kernel.py")


def _digest() -> str:
    total = hashlib.sha256()
    for name in _KERNEL_FILES:
        total.update((Path(__file__).parent / name).read_bytes())
    return total.hexdigest()


_SOURCES = _digest()


def kernel(function: Callable[..., Any]) -> Any:
    """Compile at the first call, release the interpreter lock while running, keep the code on disk."""
    dispatcher = njit(nogil=True, cache=True, error_model="numpy")(function)
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):
        index._source_stamp = _SOURCES
    return dispatcher


def inlined(function: Callable[..., Any]) -> Any:
    """A part of a kernel."""
    return njit(error_model="numpy")(function)

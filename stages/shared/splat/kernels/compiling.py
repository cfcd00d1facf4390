"""How the kernels are compiled, and a word to the user when that takes seconds.

Compiled code is kept on disk (numba's cache, beside the modules or in the user's cache folder). It depends on
the processor, which numba looks after, and on all modules of this package, since they are inlined into one
another, which numba does not: hence the digest below.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

_log = logging.getLogger("gw.splat")
_MESSAGE = "compiling the splatting kernels for this processor (once; some ten seconds)"


def _digest() -> str:
    """Of every source that ends up in compiled code."""
    folder = Path(__file__).parent
    found = hashlib.sha256()
    for source in [*sorted(folder.glob("*.py")), folder.parent / "settings.py"]:
        found.update(source.read_bytes())
    return found.hexdigest()


_SOURCES = _digest()


def kernel(function: Callable[..., Any]) -> Any:
    """Compile at the first call for the types of its arguments; no GIL while it runs; kept on disk."""
    dispatcher = njit(nogil=True, cache=True, error_model="numpy")(function)
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):  # numba's own is the one file's time and size
        index._source_stamp = _SOURCES
    return dispatcher


def inlined(function: Callable[..., Any]) -> Any:
    """A piece of a kernel: always becomes part of what calls it."""
    return njit(forceinline=True, error_model="numpy")(function)


class _Listener(event.Listener):
    """Tells the newest listening caller, or the log, of the first compilation."""

    def __init__(self) -> None:
        self.told = False
        self.compilations = 0
        self.callers: list[Callable[[str], None]] = []

    def on_start(self, event: event.Event) -> None:
        if "stages.shared.splat" not in event.data["dispatcher"].py_func.__module__:
            return
        self.compilations += 1
        if not self.told:
            self.told = True
            (self.callers[-1] if self.callers else _log.warning)(_MESSAGE)

    def on_end(self, event: event.Event) -> None:
        pass


_listener = _Listener()
event.register("numba:compile", _listener)


def compilations() -> int:
    """Functions compiled so far in this process (those read from disk do not count)."""
    return _listener.compilations


@contextmanager
def told_to(caller: Callable[[str], None]) -> Iterator[None]:
    """Send the message to `caller` instead of the log."""
    _listener.callers.append(caller)
    try:
        yield
    finally:
        _listener.callers.remove(caller)

"""How the kernels are compiled, and a message to the user, since that takes seconds.

Compiled code is cached on disk by numba, next to the modules or in the user's cache folder. It depends on the
processor, which numba checks, and on all modules of this package, which are inlined into one another. numba
does not check those; a digest of the sources does.
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
    """Digest of every source that is compiled."""
    folder = Path(__file__).parent
    content = hashlib.sha256()
    for source in [*sorted(folder.glob("*.py")), folder.parent / "settings.py"]:
        content.update(source.read_bytes())
    return content.hexdigest()


_SOURCES = _digest()


def kernel(function: Callable[..., Any]) -> Any:
    """Compile at the first call for the types of its arguments; releases the GIL; cached on disk."""
    dispatcher = njit(nogil=True, cache=True, error_model="numpy")(function)
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None and hasattr(index, "_source_stamp"):  # numba's stamp is time and size of one file
        index._source_stamp = _SOURCES
    return dispatcher


def inlined(function: Callable[..., Any]) -> Any:
    """A part of a kernel, always inlined into its caller."""
    return njit(forceinline=True, error_model="numpy")(function)


class _Listener(event.Listener):
    """Announces the first compilation to the newest listening caller, or to the log."""

    def __init__(self) -> None:
        self.announced = False
        self.compilations = 0
        self.callers: list[Callable[[str], None]] = []

    def on_start(self, event: event.Event) -> None:
        if "stages.shared.splat" not in event.data["dispatcher"].py_func.__module__:
            return
        self.compilations += 1
        if not self.announced:
            self.announced = True
            (self.callers[-1] if self.callers else _log.warning)(_MESSAGE)

    def on_end(self, event: event.Event) -> None:
        pass


_listener = _Listener()
event.register("numba:compile", _listener)


def compilations() -> int:
    """Functions compiled so far in this process (those read from disk are not counted)."""
    return _listener.compilations


@contextmanager
def announce_to(caller: Callable[[str], None]) -> Iterator[None]:
    """Send the message to `caller` instead of the log."""
    _listener.callers.append(caller)
    try:
        yield
    finally:
        _listener.callers.remove(caller)

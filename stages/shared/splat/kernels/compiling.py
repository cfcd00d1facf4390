"""Says so when kernels are being compiled: the first call on a machine takes seconds, and silence looks like a hang.

Compiled code is kept on disk (numba's cache, beside the modules or in the user's cache folder) and depends on the
processor, so that this happens once per machine and version.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

_log = logging.getLogger("gw.splat")
_MESSAGE = "compiling the splatting kernels for this processor (once; some ten seconds)"


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

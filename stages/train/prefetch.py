"""Prefetching: a thread makes what later steps need while a step is computed.

What a step sees is a function of (seed, step), so it is known in advance and does not depend on the thread.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Prefetcher(Generic[Key, Value]):
    """Makes values before they are needed. Outside of `running` it makes them when they are needed.

    Arguments:
        make: makes the value of a key; called in one other thread.
    """

    def __init__(self, make: Callable[[Key], Value]) -> None:
        self._make = make
        self._thread: ThreadPoolExecutor | None = None
        self._pending: dict[Key, Future[Value]] = {}

    @contextmanager
    def running(self) -> Iterator[None]:
        """The thread lives as long as this block. A nested block uses the thread of the outer one."""
        if self._thread is not None:
            yield
            return
        with ThreadPoolExecutor(1, thread_name_prefix="gw-prefetch") as self._thread:
            try:
                yield
            finally:
                self.schedule(())
                self._thread = None

    def schedule(self, keys: Iterable[Key]) -> None:
        """These keys are needed next, in this order; everything else is dropped."""
        if self._thread is None:
            return
        scheduled = dict.fromkeys(keys)
        for key in [key for key in self._pending if key not in scheduled]:
            self._pending.pop(key).cancel()
        for key in scheduled:
            if key not in self._pending:
                self._pending[key] = self._thread.submit(self._make, key)

    def value(self, key: Key) -> Value:
        """The value of a key; what making it raised is raised here."""
        pending = self._pending.pop(key, None)
        return self._make(key) if pending is None else pending.result()

"""Reading ahead: what later steps will need is made in a thread of its own, while a step is computed.

What a step sees is a function of (seed, step): it is known beforehand, and the same whoever makes it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Ahead(Generic[Key, Value]):
    """Values made before they are asked for; outside of `reading`, when they are.

    Arguments:
        make: makes the value of a key; is called in one thread beside the caller's.
    """

    def __init__(self, make: Callable[[Key], Value]) -> None:
        self._make = make
        self._thread: ThreadPoolExecutor | None = None
        self._coming: dict[Key, Future[Value]] = {}

    @contextmanager
    def reading(self) -> Iterator[None]:
        """The thread lives as long as this block; inside another such block it is that one's."""
        if self._thread is not None:
            yield
            return
        with ThreadPoolExecutor(1, thread_name_prefix="gw-ahead") as self._thread:
            try:
                yield
            finally:
                self.expect(())
                self._thread = None

    def expect(self, keys: Iterable[Key]) -> None:
        """These will be asked for, in this order; nothing else is kept."""
        if self._thread is None:
            return
        wanted = dict.fromkeys(keys)
        for key in [key for key in self._coming if key not in wanted]:
            self._coming.pop(key).cancel()
        for key in wanted:
            if key not in self._coming:
                self._coming[key] = self._thread.submit(self._make, key)

    def value(self, key: Key) -> Value:
        """The value of a key; what making it raised is raised here."""
        coming = self._coming.pop(key, None)
        return self._make(key) if coming is None else coming.result()

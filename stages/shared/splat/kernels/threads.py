"""A few Python threads that run one compiled function together.

The kernels release the GIL and take their work items from a shared counter. Plain threads instead of numba's
threading layers, because those either forbid calls from two threads at once, or die after a fork, or bring a
second OpenMP beside torch's. As many threads as torch uses, the caller's own among them.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_pool_size = 0


def _forget_pool() -> None:
    """A forked child has the parent's pool object but none of its threads."""
    global _lock, _pool, _pool_size
    _lock, _pool, _pool_size = threading.Lock(), None, 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def _helpers(count: int) -> ThreadPoolExecutor:
    """The pool, grown to `count` threads."""
    global _pool, _pool_size
    with _lock:
        if _pool is None or _pool_size < count:
            _pool, _pool_size = ThreadPoolExecutor(count, thread_name_prefix="gw-splat"), count
        return _pool


_watched: dict[str, float] | None = None


@contextmanager
def watch() -> Iterator[dict[str, float]]:
    """Collect wall seconds by kernel name, of all calls inside the block (for measuring; not nested)."""
    global _watched
    _watched = {}
    try:
        yield _watched
    finally:
        _watched = None


def run_alone(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Call kernel(*arguments) in this thread."""
    started = time.perf_counter()
    result = kernel(*arguments)
    if _watched is not None:
        name = kernel.__name__
        _watched[name] = _watched.get(name, 0.0) + time.perf_counter() - started
    return result


def run_together(kernel: Callable[..., Any], *arguments: Any) -> None:
    """Call kernel(turn, *arguments) in every thread; `turn` is the counter of work items they share."""
    turn = np.zeros(8, np.int64)
    threads = torch.get_num_threads()
    started = time.perf_counter()
    others = []
    if threads > 1:
        pool = _helpers(threads - 1)
        others = [pool.submit(kernel, turn, *arguments) for _ in range(threads - 1)]
    try:
        kernel(turn, *arguments)
    finally:
        for other in others:
            other.result()
    if _watched is not None:
        name = kernel.__name__
        _watched[name] = _watched.get(name, 0.0) + time.perf_counter() - started

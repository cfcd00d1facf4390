"""Runs one compiled function in several Python threads.

The kernels release the GIL and take their work items from a shared counter. numba's threading layers are not
used: they either forbid calls from two threads at once, or fail after a fork, or load a second OpenMP next to
torch's. The number of threads is torch's and includes the calling thread.
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
    """A forked child has the pool object of its parent, but not the threads."""
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


_seconds: dict[str, float] | None = None


@contextmanager
def time_kernels() -> Iterator[dict[str, float]]:
    """Measure wall seconds by kernel name, of all calls inside the block; does not nest."""
    global _seconds
    _seconds = {}
    try:
        yield _seconds
    finally:
        _seconds = None


def run_serial(kernel: Callable[..., Any], *arguments: Any) -> Any:
    """Call kernel(*arguments) in this thread."""
    started = time.perf_counter()
    result = kernel(*arguments)
    if _seconds is not None:
        name = kernel.__name__
        _seconds[name] = _seconds.get(name, 0.0) + time.perf_counter() - started
    return result


def run_parallel(kernel: Callable[..., Any], *arguments: Any) -> None:
    """Call kernel(counter, *arguments) in every thread; `counter` counts the work items handed out."""
    counter = np.zeros(8, np.int64)
    threads = torch.get_num_threads()
    started = time.perf_counter()
    others = []
    if threads > 1:
        pool = _helpers(threads - 1)
        others = [pool.submit(kernel, counter, *arguments) for _ in range(threads - 1)]
    try:
        kernel(counter, *arguments)
    finally:
        for other in others:
            other.result()
    if _seconds is not None:
        name = kernel.__name__
        _seconds[name] = _seconds.get(name, 0.0) + time.perf_counter() - started

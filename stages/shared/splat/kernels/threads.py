"""A few Python threads that run one compiled function together.

The kernels release the GIL and take their work items from a shared counter. Plain threads instead of numba's
threading layers, because those either forbid calls from two threads at once, or die after a fork, or bring a
second OpenMP beside torch's. As many threads as torch uses, the caller's own among them.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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


def run_together(kernel: Callable[..., Any], *arguments: Any, threads: int | None = None) -> None:
    """Call kernel(turn, *arguments) in every thread; `turn` is the counter of work items they share."""
    turn = np.zeros(8, np.int64)
    threads = torch.get_num_threads() if threads is None else threads
    if threads <= 1:
        kernel(turn, *arguments)
        return
    pool = _helpers(threads - 1)
    others = [pool.submit(kernel, turn, *arguments) for _ in range(threads - 1)]
    try:
        kernel(turn, *arguments)
    finally:
        for other in others:
            other.result()

"""Whole frames in parallel: one core, one frame.

A frame has parts that a second thread does not speed up (contours, Python between the kernels). On a few
cores, two frames at a time are therefore faster than one frame on two threads. Results come in order, with a
bounded look-ahead.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from stages.shared.outfit.cached_poser import CachedPoser
from stages.shared.outfit.outfit import Outfit

Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_frames(
    outfit: Outfit,
    items: Sequence[Item],
    work: Callable[[CachedPoser, Item], Result],
    threads: int | None = None,
    hidden: NDArray[np.bool_] | None = None,
    cache: bool = True,
) -> Generator[Result, None, None]:
    """`work(poser, item)` for every item, in order. Each thread has a poser, and its kernels use one thread.

    Close the iterator (`contextlib.closing`) where an error may leave it. Closing waits for items in work and
    starts no others.

    Arguments:
        threads: frames at a time; None for torch's number of threads.
        hidden, cache: as `CachedPoser` takes them.
    """
    count = min(threads or torch.get_num_threads(), max(len(items), 1))
    first = CachedPoser(outfit, hidden=hidden, cache=cache)
    if count <= 1:
        yield from (work(first, item) for item in items)
        return
    posers = [first, *(CachedPoser(outfit, share_with=first, cache=cache) for _ in range(count - 1))]
    local = threading.local()

    def task(item: Item) -> Result:
        if not hasattr(local, "poser"):
            local.poser = posers.pop()
            torch.set_num_threads(1)
        return work(local.poser, item)

    with threads_restored(), ThreadPoolExecutor(count, thread_name_prefix="gw-frame") as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(task, item))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def threads_restored() -> Iterator[None]:
    """Restores torch's number of threads: setting it in one thread also sets it for threads started later."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)

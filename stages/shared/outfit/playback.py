"""Whole frames side by side: one core, one frame.

A frame has parts that no second thread helps (contours, Python between the kernels), so on a few cores two
frames at a time are faster than one frame by two threads. Results come in order, with a bounded look-ahead.
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

from stages.shared.outfit.outfit import Outfit
from stages.shared.outfit.player import Player

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(
    outfit: Outfit,
    items: Sequence[Item],
    work: Callable[[Player, Item], Result],
    threads: int | None = None,
    hidden: NDArray[np.bool_] | None = None,
    anew: bool = False,
) -> Generator[Result, None, None]:
    """`work(player, item)` of every item, in order; each thread has a player, and its kernels one thread.

    Close the iterator (`contextlib.closing`) where an error may leave it: that waits for items at work, and
    begins no others.

    Arguments:
        threads: frames at a time; None for as many as torch would use threads.
        hidden, anew: as `Player` takes them.
    """
    count = min(threads or torch.get_num_threads(), max(len(items), 1))
    if count <= 1:
        player = Player(outfit, hidden=hidden, anew=anew)
        yield from (work(player, item) for item in items)
        return
    first = Player(outfit, hidden=hidden, anew=anew)
    spare = [first, *(Player(outfit, twin=first, anew=anew) for _ in range(count - 1))]
    own = threading.local()

    def task(item: Item) -> Result:
        if not hasattr(own, "player"):
            own.player = spare.pop()
            torch.set_num_threads(1)
        return work(own.player, item)

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
            for left in waiting:
                left.cancel()


@contextmanager
def threads_restored() -> Iterator[None]:
    """`torch.set_num_threads` in a thread also sets what threads begun later start with: put that back."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)

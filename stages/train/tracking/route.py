"""The order in which the frames of a take sequence are tracked."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Route:
    """An order of frames.

    Attributes:
        order: indices of frames. before: the frame from which each frame is reached; None for the first.
        entries: the first frame of every take.
    """

    order: list[int]
    before: dict[int, int | None]
    entries: frozenset[int]

    def earlier(self, index: int) -> int | None:
        """The frame before the one that a frame is reached from, where all three are neighbours in a take."""
        last = self.before[index]
        if last is None or self.entries & {index, last}:
            return None
        return self.before[last]


def plan_route(groups: list[list[int]], start: int, descriptions: Tensor) -> Route:
    """From `start` to the end of its take, then back to the beginning of the take; then the other takes.

    Another take is entered at the frame whose pose is nearest to a frame that has been tracked.

    Arguments:
        groups: indices of frames by take. descriptions: (K, M) poses of all frames.
    """
    order: list[int] = []
    before: dict[int, int | None] = {}
    entries = []
    for group in sorted(groups, key=lambda group: start not in group):
        entry, source = start, None
        if order:
            distance = torch.cdist(descriptions[group], descriptions[order])
            row, column = divmod(int(distance.argmin()), len(order))
            entry, source = group[row], order[column]
        forwards, backwards = [i for i in group if i > entry], [i for i in reversed(group) if i < entry]
        before |= {entry: source} | {i: i - 1 for i in forwards} | {i: i + 1 for i in backwards}
        order += [entry, *forwards, *backwards]
        entries.append(entry)
    return Route(order, before, frozenset(entries))

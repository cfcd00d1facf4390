"""A report that remembers what a stage says, and interrupts it when told to."""

from __future__ import annotations


class Listener:
    """Keeps texts, warnings and progress.

    Arguments:
        stop: this many units done raise KeyboardInterrupt, as Ctrl-C would; None never.
    """

    def __init__(self, stop: int | None = None) -> None:
        self.said: list[str] = []
        self.warnings: list[str] = []
        self.progressed: list[tuple[int, int]] = []
        self._stop = stop

    def step(self, text: str) -> None: ...

    def progress(self, done: int, total: int, **numbers: float) -> None:
        self.progressed.append((done, total))
        if done == self._stop:
            raise KeyboardInterrupt

    def say(self, text: str) -> None:
        self.said.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)

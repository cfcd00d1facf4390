"""How a stage tells the outside what it is doing, without knowing who listens."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Listener of a running stage; the command line prints it, tests and notebooks ignore it."""

    def step(self, text: str) -> None:
        """A new step of the recipe begins."""

    def progress(self, done: int, total: int, **numbers: float) -> None:
        """`done` of `total` units of the current step are finished; `numbers` are shown beside."""

    def say(self, text: str) -> None:
        """A fact worth reading."""

    def warn(self, text: str) -> None:
        """Something the user should look at, though the stage goes on."""


class Silent:
    """A report that nobody reads."""

    def step(self, text: str) -> None: ...

    def progress(self, done: int, total: int, **numbers: float) -> None: ...

    def say(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


SILENT: Report = Silent()

"""Progress and messages of a running stage."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Receiver of the messages of a stage. The command line prints them; tests and notebooks ignore them."""

    def step(self, text: str) -> None:
        """A new step of the stage starts."""

    def progress(self, done: int, total: int, **numbers: float) -> None:
        """`done` of `total` units of the current step are finished; `numbers` are shown with it."""

    def say(self, text: str) -> None:
        """A message for the user."""

    def warn(self, text: str) -> None:
        """A warning. The stage continues."""


class Silent:
    """A report that ignores all messages."""

    def step(self, text: str) -> None: ...

    def progress(self, done: int, total: int, **numbers: float) -> None: ...

    def say(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


SILENT: Report = Silent()

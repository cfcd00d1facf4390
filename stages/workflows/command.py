"""How a workflow runs a command: the front end passes a function that does it.

The demo and the trade-off report seconds and peak memory of every command, so each runs in a process of its
own. Only the command line knows how to start one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Protocol


@dataclass(frozen=True)
class Outcome:
    """What one command gave: wall seconds, peak bytes of the process, and its result."""

    seconds: float
    peak_bytes: int
    result: dict[str, Any]


class RunCommand(Protocol):
    """Runs `gw` with these arguments; raises a `GwError` when it fails.

    Arguments:
        folder: working folder. threads: at most so many, unless the environment says otherwise.
        cancelled: ends the command when it is set.
    """

    def __call__(
        self,
        *arguments: str | Path,
        folder: Path | None = None,
        threads: int | None = None,
        cancelled: Event | None = None,
    ) -> Outcome: ...

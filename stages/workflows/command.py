"""How a workflow runs a command. The front end passes the function.

The demo and the trade-off report seconds and peak memory of every command, so each runs in its own
process. Only the command line knows how to start one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Protocol


@dataclass(frozen=True)
class Outcome:
    """The outcome of one command: wall seconds, peak bytes of the process, and the result."""

    seconds: float
    peak_bytes: int
    result: dict[str, Any]


class RunCommand(Protocol):
    """Run `gw` with these arguments. Raises a `GwError` when it fails.

    Arguments:
        folder: working folder. threads: maximum number of threads, unless the environment sets it.
        cancelled: setting it ends the command.
    """

    def __call__(
        self,
        *arguments: str | Path,
        folder: Path | None = None,
        threads: int | None = None,
        cancelled: Event | None = None,
    ) -> Outcome: ...

"""The progress bar on a terminal. Importing it loads rich.progress; a command that draws no bar does not."""

from __future__ import annotations

import io
import shutil
from typing import IO, cast

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

from gw_cli import streams


class _StandardError(io.TextIOBase):
    """Standard error whose loss is not an error (`streams.write`)."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        streams.write("stderr", text)
        return len(text)


class Bar:
    """A bar for one step; it moves once `update` knows how many units there are."""

    def __init__(self, text: str) -> None:
        console = Console(
            file=cast(IO[str], _StandardError()),
            force_terminal=True,
            width=shutil.get_terminal_size().columns,
            markup=False,
            highlight=False,
        )
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[state]}", markup=False),
            console=console,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
            refresh_per_second=5,
        )
        self._task = self._progress.add_task(text, total=None, state="")
        self._progress.start()

    def update(self, done: int, total: int, state: str) -> None:
        """Show that `done` of `total` units are finished."""
        self._progress.update(self._task, completed=done, total=total, state=state)

    def print_above(self, text: str) -> None:
        """Print a line that stays."""
        self._progress.console.print(text, soft_wrap=True)

    def close(self) -> None:
        """Take the bar off the terminal."""
        self._progress.stop()

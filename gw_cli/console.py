"""What a running command prints: lines and bars for people, or JSON lines for programs.

People's text goes to stderr. With `--json`, stdout carries one JSON object per line, and the last one is
`{"result": {...}}` or `{"error": {...}}`.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gw_cli import failures, streams
from gw_cli.failures import command as command
from gw_cli.readable import duration, plan_lines, result_lines
from gw_cli.streams import shown
from stages.shared.plan import Plan

if TYPE_CHECKING:
    from gw_cli.bar import Bar

_PROGRESS_SECONDS = 5.0  # between two lines where no bar can be drawn
_WORTH_TELLING = 1.0  # s that a step or a command took


class Console:
    """Listens to a stage (`stages.shared.report.Report`) and prints for people or for programs."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self._terminal = streams.is_terminal("stderr") and not as_json
        self._bar: Bar | None = None
        self._step, self._step_started, self._last_progress = "", time.monotonic(), 0.0
        failures.current.close_bar = self._close_bar

    def loading(self) -> None:
        """Say that the command has begun; called before the import of large libraries."""
        self.step("loading libraries")

    def step(self, text: str) -> None:
        """A new step of the recipe begins."""
        self._close_bar()
        self._step, self._step_started, self._last_progress = text, time.monotonic(), time.monotonic()
        if self._terminal:
            from gw_cli.bar import Bar

            self._bar = Bar(shown(text))
        else:
            self._emit({"event": "step", "text": text}, f"{text} …")

    def progress(self, done: int, total: int, **numbers: float) -> None:
        """`done` of `total` units of the step are finished; `numbers` are measurements to show."""
        now = time.monotonic()
        if self._bar is None and now - self._last_progress < _PROGRESS_SECONDS and done < total:
            return
        self._last_progress = now
        rate = done / max(now - self._step_started, 1e-9)
        left = f"  {duration((total - done) / rate)} left" if 0 < done < total else ""
        measures = "".join(f"  {name} {value:.4g}" for name, value in numbers.items())
        text = f"{done}/{total}  {rate:.3g}/s{left}{measures}"
        if self._bar is not None:
            self._bar.update(done, total, shown(text))
            return
        event = {"event": "progress", "step": self._step, "done": done, "total": total, "rate": rate}
        self._emit({**event, **numbers}, f"{self._step} {text}".strip())

    def say(self, text: str) -> None:
        """A fact worth reading."""
        self._emit({"event": "say", "text": text}, text)

    def warn(self, text: str) -> None:
        """Something the user should look at, though the command goes on."""
        self._emit({"event": "warning", "text": text}, f"warning: {text}")

    def plan(self, plan: Plan) -> None:
        """Print the plan of `--dry-run`."""
        self._close_bar()
        if self.as_json:
            self.result({"dry_run": True, **dataclasses.asdict(plan)})
            return
        self._print("dry run: nothing is written")
        for line in plan_lines(plan, failures.current.verbose):
            self._print(f"  {line}")

    def result(
        self,
        result: dict[str, Any],
        next_command: str | Sequence[str | Path] | None = None,
        when: str = "",
        watch: Path | None = None,
    ) -> None:
        """Print the result of a command, how long it took, and what to do next.

        Arguments:
            next_command: the command to type next; words are quoted for the shell.
            when: a comment after that command. watch: a film or page to look at.
        """
        self._close_bar()
        if self.as_json:
            streams.write("stdout", json.dumps({"result": result}, allow_nan=False, default=_plain) + "\n")
            return
        for line in result_lines(result, failures.current.verbose):
            self._print(f"  {line}")
        seconds = time.monotonic() - (failures.current.started or time.monotonic())
        if seconds > _WORTH_TELLING:
            self._print(f"  took {duration(seconds)}")
        if watch is not None:
            self._print(f"watch: {watch.resolve().as_uri()}")
        if next_command:
            line = next_command if isinstance(next_command, str) else shlex.join(map(str, next_command))
            self._print(f"next: {line}" + (f"   # {when}" if when else ""))

    def _emit(self, event: dict[str, Any], text: str) -> None:
        if self.as_json:
            streams.write("stdout", json.dumps(event, default=_plain) + "\n")
        else:
            self._print(f"  {text}")

    def _print(self, text: str) -> None:
        if self._bar is not None:
            self._bar.print_above(shown(text))
        else:
            streams.write("stderr", shown(text) + "\n")

    def _close_bar(self) -> None:
        """Take the bar away, and leave a line that says how long its step took."""
        if self._bar is None:
            return
        self._bar.close()
        self._bar = None
        seconds = time.monotonic() - self._step_started
        self._print(f"  {self._step}" + (f"  {duration(seconds)}" if seconds > _WORTH_TELLING else ""))


def _plain(value: Any) -> Any:
    """What json cannot write by itself: paths, dataclasses, numpy scalars."""
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if hasattr(value, "item"):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")

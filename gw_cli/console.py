"""People or JSON lines, and exit codes: decided here for every command.

People's text goes to stderr. With `--json`, stdout carries one JSON object a line and the last one is
`{"result": {...}}`. Errors are three lines: what is wrong, where, what to do; also those of a
command line that cannot be read.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import typer

from gw_cli import streams
from gw_cli.help import HelpGroup
from gw_cli.streams import shown
from stages.shared.errors import GwError, StorageFailure, UsageProblem
from stages.shared.memory import is_memory_error, memory_refusal
from stages.shared.plan import Plan

Command = TypeVar("Command", bound=Callable[..., Any])

# Typer carries a click of its own in some versions and not in others; this is the class in either case.
_UsageError: Any = typer.BadParameter.__mro__[1]
INTERRUPTED = 130  # exit code after SIGINT and SIGTERM
_PROGRESS_SECONDS_TERMINAL = 0.2
_PROGRESS_SECONDS_PIPE = 30.0


class Console:
    """Listens to a stage (`stages.shared.report.Report`) and prints for people or for programs."""

    def __init__(self, as_json: bool = False) -> None:
        self.as_json = as_json
        self._terminal = streams.is_terminal("stderr")
        self._step = ""
        self._step_started = time.monotonic()
        self._last_progress = 0.0
        self._line_open = False

    def step(self, text: str) -> None:
        self._step, self._step_started, self._last_progress = text, time.monotonic(), 0.0
        self._emit({"event": "step", "text": text}, f"  {text} …")

    def progress(self, done: int, total: int, **numbers: float) -> None:
        now = time.monotonic()
        pause = _PROGRESS_SECONDS_TERMINAL if self._terminal else _PROGRESS_SECONDS_PIPE
        if now - (self._last_progress or self._step_started) < pause and done < total:
            return
        self._last_progress = now
        elapsed = now - self._step_started
        rate = done / elapsed if elapsed > 0 else 0.0
        eta = (total - done) / rate if rate > 0 else float("nan")
        measures = "  ".join(f"{name} {value:.4g}" for name, value in numbers.items())
        text = f"  {self._step} {done}/{total}  {rate:.2f}/s  left {eta:.0f} s  {measures}".rstrip()
        event = {
            "event": "progress",
            "step": self._step,
            "done": done,
            "total": total,
            "rate": rate,
            **numbers,
        }
        if self._terminal and not self.as_json:
            streams.write("stderr", "\r\x1b[2K" + shown(text))
            self._line_open = True
        else:
            self._emit(event, text)

    def say(self, text: str) -> None:
        self._emit({"event": "say", "text": text}, f"  {text}")

    def warn(self, text: str) -> None:
        self._emit({"event": "warning", "text": text}, f"  warning: {text}")

    def plan(self, plan: Plan) -> None:
        """Print what `--dry-run` found; nothing was written."""
        if self.as_json:
            self.result({"dry_run": True, **dataclasses.asdict(plan)})
            return
        self._people("dry run: nothing is written")
        for title, rows in (("reads", plan.inputs), ("writes", plan.outputs)):
            for row in rows:
                self._people(f"  {title:6} {row}")
        for name, value in plan.config.items():
            self._people(f"  {name} = {value}")
        for title, parts in plan.scene.items():
            for name, value in parts.items():
                self._people(f"  {title.replace('_', ' ')}: {name}: {_readable(value)}")
        cost = {
            "time": None if plan.seconds is None else f"{plan.seconds:.0f} s",
            "memory": None if plan.memory_bytes is None else f"{plan.memory_bytes / 2**20:.0f} MiB",
            "disk": None if plan.disk_bytes is None else f"{plan.disk_bytes / 2**20:.1f} MiB",
        }
        self._people("  estimated " + ", ".join(f"{name} {text or 'unknown'}" for name, text in cost.items()))

    def result(self, result: dict[str, Any], next_command: str | None = None) -> None:
        """Print the result of a command, and the command to type next."""
        if self.as_json:
            streams.write("stdout", json.dumps({"result": result}, allow_nan=False, default=_plain) + "\n")
            return
        for name, value in result.items():
            self._people(f"  {name}: {_readable(value)}")
        if next_command:
            self._people(f"next: {next_command}")

    def _emit(self, event: dict[str, Any], text: str) -> None:
        if self.as_json:
            streams.write("stdout", json.dumps(event, default=_plain) + "\n")
        else:
            self._people(text)

    def _people(self, text: str) -> None:
        if self._line_open:
            streams.write("stderr", "\n")
            self._line_open = False
        streams.write("stderr", shown(text) + "\n")


def _plain(value: Any) -> Any:
    """What json cannot write by itself: paths, dataclasses, numpy scalars."""
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if hasattr(value, "item"):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_readable(item)}" for name, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_readable(item) for item in value)
    return str(value)


class CommandTable(HelpGroup):
    """The commands; what cannot be parsed gets three lines like every other error."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        call = functools.partial(
            super().main, args, prog_name, complete_var, False, windows_expand_args, **extra
        )
        if not standalone_mode:
            return call()
        try:
            status = call()
        except _UsageError as error:
            status = _say_misuse(error)
        except GwError as error:  # from the check of an option
            _print_three_lines(error)
            status = error.exit_code
        except KeyboardInterrupt:
            status = say_interrupted()
        except OSError:  # the help could not be written: the reader has left, or the disk is full
            status = StorageFailure.exit_code
        sys.exit(streams.exit_code(status if isinstance(status, int) else 0))


def _say_misuse(error: Any) -> int:
    """Print what is wrong with a command line, or the help of a group that was called without a command."""
    if type(error).__name__ == "NoArgsIsHelpError":
        streams.write("stdout", error.ctx.get_help() + "\n")
        return UsageProblem.exit_code
    name = error.ctx.command_path if error.ctx else "gw"
    usage = " ".join(error.ctx.get_usage().split()).removeprefix("Usage: ") if error.ctx else name
    what = " ".join(error.format_message().split())
    _print_three_lines(UsageProblem(what, name, f"Write: {usage}; {name} --help says more."))
    return UsageProblem.exit_code


def _print_three_lines(error: GwError) -> None:
    streams.write(
        "stderr", f"error: {shown(error.what)}\n where: {shown(error.where)}\n   fix: {shown(error.fix)}\n"
    )


def say_interrupted() -> int:
    """Print one line for Ctrl-C and SIGTERM; returns the exit code."""
    streams.write("stderr", "interrupted; finished artifacts are kept, the same command goes on from here\n")
    return INTERRUPTED


def fail(error: GwError) -> NoReturn:
    """Print the three lines and leave with the error's exit code."""
    _print_three_lines(error)
    raise typer.Exit(error.exit_code)


def command(function: Command) -> Command:
    """Turn what a command raises into messages and exit codes (0 2 65 66 70 74 75 130)."""

    @functools.wraps(function)
    def guarded(*arguments: Any, **options: Any) -> Any:
        try:
            return function(*arguments, **options)
        except GwError as error:
            fail(error)
        except KeyboardInterrupt:
            raise typer.Exit(say_interrupted()) from None
        except (typer.Exit, typer.Abort):
            raise
        except BrokenPipeError:
            raise typer.Exit(StorageFailure.exit_code) from None  # whoever read the output has left
        except Exception as error:
            if is_memory_error(error):
                fail(memory_refusal(f"gw {function.__name__.rstrip('_').replace('_', '-')}"))
            fail(_storage_failure(error) if isinstance(error, OSError) else _our_bug(error))

    return guarded  # type: ignore[return-value]


def _storage_failure(error: OSError) -> GwError:
    where = str(error.filename or "the file system")
    if error.errno == errno.ENOSPC:
        return StorageFailure("The disk is full.", where, "Free some space and run the same command again.")
    reason = error.strerror or str(error)
    return StorageFailure(
        f"Reading or writing failed: {reason}.", where, "Check the path and its permissions."
    )


def _our_bug(error: Exception) -> GwError:
    """The last resort: whatever else is broken, it says what happened."""
    try:
        what = f"A bug in gw: {type(error).__name__}: {error}"
    except Exception:  # an exception that cannot be printed
        what = f"A bug in gw: {type(error).__name__}"
    try:
        details = " ".join(sys.argv) + "\n" + "".join(traceback.format_exception(error))
        with tempfile.NamedTemporaryFile("wb", prefix="gw-report-", suffix=".txt", delete=False) as report:
            report.write(details.encode(errors="backslashreplace"))
        return GwError(what, report.name, "Please file this report; nothing half-written was left behind.")
    except Exception:  # no room for a report, or a traceback that cannot be formatted
        last = traceback.extract_tb(error.__traceback__)[-1:]
        where = f"{last[0].filename}, line {last[0].lineno}" if last else "unknown"
        return GwError(what, where, "Please report it; no file could be written with the details.")

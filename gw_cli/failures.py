"""What a command raises becomes messages and exit codes, the same for every command.

An error is three lines on standard error: what is wrong, where, what to do. With `--json` standard output
also has one object: {"error": {"what", "where", "fix", "exit_code"}}.
"""

from __future__ import annotations

import errno
import functools
import inspect
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

import typer

from gw_cli import streams
from gw_cli.help import HelpGroup, usage
from gw_cli.options import Verbose
from gw_cli.streams import shown
from stages.shared.errors import GwError, StorageFailure, UsageProblem
from stages.shared.memory import is_memory_error, memory_refusal

Command = TypeVar("Command", bound=Callable[..., Any])

# Some versions of Typer carry a copy of click and some do not; this is the class in either case.
_UsageError: Any = typer.BadParameter.__mro__[1]
INTERRUPTED = 130  # exit code after SIGINT and SIGTERM


@dataclass
class Invocation:
    """The command that is running.

    Attributes:
        started: time.monotonic() of its begin; None where no command runs.
        close_bar: takes a progress bar off the terminal.
    """

    as_json: bool = False
    verbose: bool = False
    started: float | None = None
    close_bar: Callable[[], None] = lambda: None


current = Invocation()


def command(function: Command) -> Command:
    """Give a command `--verbose`, and turn what it raises into messages and exit codes.

    The exit codes are 0, 2, 65, 66, 70, 74, 75 and 130.
    """
    signature = inspect.signature(function, eval_str=True)
    parameters = list(signature.parameters.values())
    if "as_json" in signature.parameters:
        verbose = inspect.Parameter(
            "verbose", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Verbose
        )
        parameters.insert([*signature.parameters].index("as_json"), verbose)
        parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]

    @functools.wraps(function)
    def guarded(*arguments: Any, **options: Any) -> Any:
        global current
        current = Invocation(bool(options.get("as_json")), options.pop("verbose", False), time.monotonic())
        try:
            return function(*arguments, **options)
        except GwError as error:
            fail(error)
        except KeyboardInterrupt:
            raise typer.Exit(print_interrupted()) from None
        except (typer.Exit, typer.Abort):
            raise
        except BrokenPipeError:
            raise typer.Exit(StorageFailure.exit_code) from None  # the reader of the output has left
        except Exception as error:
            if is_memory_error(error):
                fail(memory_refusal(f"gw {function.__name__.rstrip('_').replace('_', '-')}"))
            fail(_storage_failure(error) if isinstance(error, OSError) else _our_bug(error))
        finally:
            current.close_bar()
            current.started = None

    guarded.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return guarded  # type: ignore[return-value]


class CommandTable(HelpGroup):
    """The commands; a command line that cannot be parsed fails as every other error does."""

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
        global current
        current = Invocation("--json" in (sys.argv if args is None else args))
        try:
            status = call()
        except _UsageError as error:
            status = _print_misuse(error)
        except GwError as error:  # from the check of an option
            _print_error(error)
            status = error.exit_code
        except KeyboardInterrupt:
            status = print_interrupted()
        except OSError:  # the help could not be written: the reader has left, or the disk is full
            status = StorageFailure.exit_code
        sys.exit(streams.exit_code(status if isinstance(status, int) else 0))


def fail(error: GwError) -> NoReturn:
    """Print the error and leave with its exit code."""
    _print_error(error)
    raise typer.Exit(error.exit_code)


def _print_misuse(error: Any) -> int:
    """Print what is wrong with a command line, or the help of a group that was called without a command."""
    if type(error).__name__ == "NoArgsIsHelpError":
        streams.write("stdout", error.format_message() + "\n")
        return UsageProblem.exit_code
    name = error.ctx.command_path if error.ctx else "gw"
    form = usage(error.ctx).removeprefix("Usage: ") if error.ctx else name
    what = " ".join(error.format_message().split())
    _print_error(UsageProblem(what, name, f"Write: {form}; {name} --help says more."))
    return UsageProblem.exit_code


def _print_error(error: GwError) -> None:
    current.close_bar()
    what, where, fix = shown(error.what), shown(error.where), shown(error.fix)
    streams.write("stderr", f"error: {what}\n where: {where}\n   fix: {fix}\n")
    _print_json(what, where, fix, error.exit_code)


def print_interrupted() -> int:
    """Print one line for Ctrl-C and SIGTERM; returns the exit code."""
    current.close_bar()
    what, fix = "interrupted", "finished artifacts are kept, the same command goes on from here"
    streams.write("stderr", f"{what}; {fix}\n")
    _print_json(what, "signal", fix, INTERRUPTED)
    return INTERRUPTED


def _print_json(what: str, where: str, fix: str, exit_code: int) -> None:
    if current.as_json:
        error = {"what": what, "where": where, "fix": fix, "exit_code": exit_code}
        streams.write("stdout", json.dumps({"error": error}) + "\n")


def _storage_failure(error: OSError) -> GwError:
    where = str(error.filename or "the file system")
    if error.errno == errno.ENOSPC:
        return StorageFailure("The disk is full.", where, "Free some space and run the same command again.")
    reason = error.strerror or str(error)
    return StorageFailure(
        f"Reading or writing failed: {reason}.", where, "Check the path and its permissions."
    )


def _our_bug(error: Exception) -> GwError:
    """The error for an unexpected exception, with the file that holds its traceback. Never raises."""
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

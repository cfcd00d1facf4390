"""The commands that a user would type, run as child processes: each has the peak memory of its own."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from threading import Event

from stages.shared.errors import GwError
from stages.workflows.command import Outcome

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_PAUSE = 0.05  # seconds between two looks at a command that may be cancelled


class CommandFailed(GwError):
    """A command did not end well; its own three lines and its exit code are passed on.

    Arguments:
        printed: its standard output, whose last line is {"error": …} unless it was killed.
    """

    def __init__(self, command: str, exit_code: int, printed: str) -> None:
        last_line = (printed.strip().splitlines() or [""])[-1]
        error: dict[str, str] = {}
        with contextlib.suppress(ValueError, AttributeError):
            error = json.loads(last_line).get("error", {})
        what = error.get("what", f"it ended with {exit_code}")
        super().__init__(
            f"The command `{command}` failed: {what}",
            error.get("where", last_line or command),
            error.get("fix", "Run it by itself."),
        )
        self.exit_code = exit_code


def run_command(
    *arguments: str | Path,
    folder: Path | None = None,
    threads: int | None = None,
    cancelled: Event | None = None,
    module: str = "gw_cli",
) -> Outcome:
    """Run `gw` (or another module) with these arguments and `--json`; see `RunCommand`.

    Raises:
        CommandFailed: the command failed or was cancelled.
    """
    words = [str(argument) for argument in arguments]
    limits = {} if threads is None else dict.fromkeys(_THREADS, str(threads))
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as stdout:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *words, "--json"],
            stdout=stdout,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env={**limits, **os.environ},
        )
        # wait4 and not wait: it gives the peak memory of this one child.
        pid, status, usage = os.wait4(process.pid, 0 if cancelled is None else os.WNOHANG)
        while cancelled is not None and pid == 0:
            if cancelled.wait(_PAUSE):
                process.terminate()
            pid, status, usage = os.wait4(process.pid, 0 if cancelled.is_set() else os.WNOHANG)
        process.returncode = os.waitstatus_to_exitcode(status)
        stdout.seek(0)
        printed = stdout.read()
        if process.returncode != 0:
            raise CommandFailed(shlex.join(["gw", *words]), max(process.returncode, 1), printed)
        result = json.loads(printed.strip().splitlines()[-1]).get("result", {})
    return Outcome(time.monotonic() - started, usage.ru_maxrss * 1024, result)

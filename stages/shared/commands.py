"""The commands that a user would type, run as child processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.shared.errors import BadData


@dataclass(frozen=True)
class Outcome:
    """What one command gave: wall seconds, peak bytes of the process, and its result."""

    seconds: float
    peak_bytes: int
    result: dict[str, Any]


def run_command(*arguments: str | Path, folder: Path | None = None) -> Outcome:
    """Run `gw` with these arguments and `--json`, in `folder` if one is given.

    Raises:
        BadData: the command failed; its own message is passed on.
    """
    words = [str(argument) for argument in arguments]
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as stdout, tempfile.TemporaryFile("w+") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "gw_cli", *words, "--json"], stdout=stdout, stderr=stderr, cwd=folder
        )
        # wait4 and not wait: it gives the peak memory of this one child.
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        stdout.seek(0)
        stderr.seek(0)
        if process.returncode != 0:
            message = " / ".join(stderr.read().strip().splitlines()[-3:])
            raise BadData(f"The command `gw {' '.join(words)}` failed.", message, "Run it by itself.")
        result = json.loads(stdout.read().strip().splitlines()[-1]).get("result", {})
    return Outcome(time.monotonic() - started, usage.ru_maxrss * 1024, result)

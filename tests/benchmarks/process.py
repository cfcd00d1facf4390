"""Child processes of a benchmark, with wall time, peak memory and result."""

from __future__ import annotations

from pathlib import Path

from gw_cli.child import run_command
from stages.workflows.command import Outcome

__all__ = ["Outcome", "run_command", "run_module"]


def run_module(module: str, *arguments: str | Path) -> Outcome:
    """Run `python -m MODULE` with these arguments and `--json`."""
    return run_command(*arguments, module=module)

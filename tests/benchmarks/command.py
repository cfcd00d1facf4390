"""One benchmark as a command line: `python -m tests.benchmarks.NAME`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer

from gw_cli.console import command


def application(function: Callable[..., Any]) -> typer.Typer:
    """The command line of one function: typer reads its parameters, errors become three lines."""
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command()(command(function))
    return app

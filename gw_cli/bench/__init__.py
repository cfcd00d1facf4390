"""`gw bench`: measurements on a user's own data. One module per subcommand, with `register(bench)`."""

from __future__ import annotations

import importlib

import typer

# Modules of this package; the order is the one `gw bench --help` shows.
SUBCOMMANDS: tuple[str, ...] = (
    "playback",
    "tradeoff",
    "paper",
    "curves",
)


def register(app: typer.Typer) -> None:
    bench = typer.Typer(
        help="Measure the trade of speed for accuracy, and methods against each other.", no_args_is_help=True
    )
    app.add_typer(bench, name="bench")

    @bench.callback()
    def group() -> None:
        """Measure the trade of speed for accuracy on a capture, and methods against each other."""

    for name in SUBCOMMANDS:
        importlib.import_module(f"gw_cli.bench.{name}").register(bench)

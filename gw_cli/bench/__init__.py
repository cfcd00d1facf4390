"""`gw bench`: what it costs and what it is worth. One module per subcommand, each with `register(bench)`."""

from __future__ import annotations

import importlib

import typer

# Modules of this package; the order is the one `gw bench --help` shows.
SUBCOMMANDS: tuple[str, ...] = (
    "splat",
    "step",
    "economy",
    "tryon",
    "precision",
    "stability",
    "playback",
    "tradeoff",
    "paper",
    "curves",
    "templates",
    "scale",
)


def register(app: typer.Typer) -> None:
    bench = typer.Typer(help="Measure speed, memory and accuracy.", no_args_is_help=True)
    app.add_typer(bench, name="bench")

    @bench.callback()
    def group() -> None:
        """Measure speed, memory and accuracy: of this machine, a subject, a capture, or the method."""

    for name in SUBCOMMANDS:
        importlib.import_module(f"gw_cli.bench.{name}").register(bench)

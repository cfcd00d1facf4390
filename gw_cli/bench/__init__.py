"""`gw bench`: measurements on a user's own data. One module per subcommand, with `register(bench)`."""

from __future__ import annotations

import importlib

from gw_cli.help import CommandApp

# Modules of this package; the order is the one `gw bench --help` shows.
SUBCOMMANDS: tuple[str, ...] = (
    "playback",
    "tradeoff",
    "paper",
    "curves",
)


def register(app: CommandApp) -> None:
    bench = app.add_group(
        "bench", "Measure the trade of speed for accuracy on a capture, and methods against each other."
    )
    for name in SUBCOMMANDS:
        importlib.import_module(f"gw_cli.bench.{name}").register(bench)

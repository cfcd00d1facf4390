"""The table of commands: what makes avatars, what wears them, what measures.

Command modules are light. A command imports what is heavy (torch, open3d, …) only when it runs, so that
`gw --help` answers at once.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Annotated

import typer

from gw_cli import streams
from gw_cli.failures import CommandTable, print_interrupted
from gw_cli.help import CommandApp

# Torch reads this when it loads. Without it, torch's idle threads spin for milliseconds after every operation
# and keep a core from the splatting threads; measured, that made frames up to five times slower.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Modules of this package, each with `register(app)`, by the box and in the order of `gw --help`.
COMMANDS: dict[str, tuple[str, ...]] = {
    "Make": (
        "import_capture",
        "register_template",
        "label",
        "canonicalize",
        "segment_layers",
        "bake_maps",
        "train",
        "distill",
        "fit_cloth",
        "export_garment",
        "synth",
        "demo",
        "pipeline",
        "status",
        "clean",
    ),
    "Wear": ("wardrobe", "inspect", "poses", "tryon", "render", "view"),
    "Measure": ("evaluate", "bench", "verify", "doctor"),
}


def _show_version(requested: bool) -> None:
    if requested:
        from importlib import metadata

        try:
            typer.echo(metadata.version("gaussian-wardrobe"))
        except metadata.PackageNotFoundError:
            typer.echo("not installed")
        raise typer.Exit


app = CommandApp(
    name="gw",
    cls=CommandTable,
    help="Learn a body and its garments from multi-view video; wear them elsewhere.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def group(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version.")
    ] = False,
) -> None:
    """Learn a body and its garments from multi-view video; wear them elsewhere."""


for _panel, _modules in COMMANDS.items():
    app.panel = _panel
    for _module in _modules:
        importlib.import_module(f"gw_cli.{_module}").register(app)


def main() -> None:
    """Entry point of the command `gw`."""
    streams.prepare()
    try:
        app()
    except KeyboardInterrupt:  # while the commands were being put together
        sys.exit(print_interrupted())
    finally:
        streams.ignore_signals()

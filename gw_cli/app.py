"""The command table, in the order of the pipeline.

Command modules are light: what is heavy (torch, open3d, …) is imported when a command runs, so that
`gw --help` answers at once.
"""

from __future__ import annotations

import importlib
import os
from typing import Annotated

import typer

from gw_cli import streams
from gw_cli.console import CommandTable

# Read when torch loads. Its idle threads would otherwise spin for milliseconds after every operation, on the
# core that the splatting threads (or another process) could use: measured, that cost up to five times.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Modules of this package, each with `register(app)`; the order is the one `gw --help` shows.
COMMANDS: tuple[str, ...] = (
    "import_capture",
    "register_template",
    "canonicalize",
    "segment_layers",
    "bake_maps",
    "train",
    "distill",
    "fit_cloth",
    "export_garment",
    "inspect",
    "wardrobe",
    "poses",
    "tryon",
    "render",
    "view",
    "evaluate",
    "synth",
    "demo",
    "status",
    "verify",
    "clean",
    "doctor",
    "pipeline",
    "bench",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        try:
            typer.echo(metadata.version("gaussian-wardrobe"))
        except metadata.PackageNotFoundError:
            typer.echo("not installed")
        raise typer.Exit


app = typer.Typer(
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


for _name in COMMANDS:
    importlib.import_module(f"gw_cli.{_name}").register(app)


def main() -> None:
    """Entry point of the command `gw`."""
    streams.prepare()
    app()

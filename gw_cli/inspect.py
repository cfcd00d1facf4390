"""`gw inspect`: what is in a bundle?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.completion import bundles
from gw_cli.console import Console, command
from gw_cli.options import Json


def register(app: typer.Typer) -> None:
    @app.command("inspect")
    @command
    def inspect(
        bundle: Annotated[
            Path, typer.Argument(metavar="FILE.gwg", help="A body or a garment.", autocompletion=bundles)
        ],
        preview: Annotated[
            Path | None, typer.Option(help="Also write the picture inside to this PNG file.")
        ] = None,
        tensors: Annotated[bool, typer.Option("--tensors", help="List every tensor.")] = False,
        as_json: Json = False,
    ) -> None:
        """Show what a bundle is: kind, slots, size, what it was made with, how good it is.

        Only the header is read, even of a large file. `gw verify FILE.gwg` reads and checks every byte.
        """
        from stages.shared.artifacts.bundle import read_bundle, read_card
        from stages.shared.outfit.describe import describe

        console = Console(as_json)
        card = read_card(bundle)
        shown = describe(card)
        if tensors:
            shown["tensors"] = {name: f"{kind} {list(shape)}" for name, (kind, shape) in card.tensors.items()}
        if preview is not None:
            from stages.shared.artifacts.files import write_whole
            from stages.shared.artifacts.pictures import encode_png

            write_whole(preview, encode_png(read_bundle(bundle).arrays["preview"]))
            shown["preview"] = str(preview)
        console.result(shown, next_command=("gw", "verify", bundle))

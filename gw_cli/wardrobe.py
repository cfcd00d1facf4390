"""`gw wardrobe`: a folder of bodies and garments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli import completion
from gw_cli.console import Console, command
from gw_cli.help import CommandApp
from gw_cli.inputs import check_poses
from gw_cli.options import Json, Pixels

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="The wardrobe: a folder of .gwg files.")]


def register(app: CommandApp) -> None:
    group = app.add_group("wardrobe", "Keep bodies and garments in one folder.")
    _list(group)
    _add(group)
    _remove(group)
    _outfits(group)


def _list(group: CommandApp) -> None:
    @group.command("list")
    @command
    def list_(folder: Folder, as_json: Json = False) -> None:
        """What is there, how large, and which garment goes on which body.

        own: learned together; fits: made with the same body model; converted: with another one, carried over
        by its bones; no: with another one, from a version that did not say where its bones were.
        """
        from stages.shared.outfit.describe import describe, fit
        from stages.shared.outfit.wardrobe import pieces

        console = Console(as_json)
        found = pieces(folder)
        bodies = {p.name: p.card for p in found if p.card and p.card.manifest["kind"] == "body"}
        rows: list[dict[str, Any]] = []
        for piece in found:
            if piece.card is None:
                rows.append({"name": piece.name, "problem": piece.problem})
                continue
            row = {"name": piece.name, **describe(piece.card)}
            if row["kind"] == "garment":
                row["on"] = {name: fit(piece.card, body) for name, body in bodies.items()}
            rows.append(row)
        if as_json:
            console.result({"wardrobe": str(folder), "pieces": rows})
            return
        table: dict[str, Any] = {}
        for row in rows:
            if "problem" in row:
                table[row["name"]] = row["problem"]
                continue
            takes = "body" if row["kind"] == "body" else "+".join(row["slots"])
            on = ", ".join(f"{body} {how}" for body, how in row.get("on", {}).items())
            table[row["name"]] = (
                f"{takes:12} {row['gaussians']:7d} Gaussians {row['bytes'] / 2**20:6.1f} MiB  "
                f"{row['digest'][:12]}  {on}".rstrip()
            )
        console.result(table)


def _add(group: CommandApp) -> None:
    @group.command("add")
    @command
    def add(
        folder: Folder,
        bundles: Annotated[
            list[Path],
            typer.Argument(
                metavar="FILE.gwg …", help="Bundles to put there.", autocompletion=completion.bundles
            ),
        ],
        name: Annotated[str, typer.Option(help="Its name there; default: that of the file.")] = "",
        as_json: Json = False,
    ) -> None:
        """Check bundles completely and copy them into the wardrobe, with their previews."""
        from stages.shared.errors import UsageProblem
        from stages.shared.outfit.wardrobe import add_piece

        console = Console(as_json)
        if name and len(bundles) > 1:
            raise UsageProblem("Several bundles cannot have one name.", "option --name", "Add one by one.")
        added = [add_piece(folder, bundle, name) for bundle in bundles]
        digests = {piece.name: piece.card.digest for piece in added if piece.card}
        console.result({"added": digests}, next_command=("gw", "wardrobe", "list", folder))


def _remove(group: CommandApp) -> None:
    @group.command("remove")
    @command
    def remove(
        folder: Folder,
        name: Annotated[
            str, typer.Argument(metavar="NAME", help="Name of a piece, or the start of its digest.")
        ],
        as_json: Json = False,
    ) -> None:
        """Take a piece out: its file is deleted."""
        from stages.shared.outfit.wardrobe import remove_piece

        Console(as_json).result({"removed": str(remove_piece(folder, name))})


def _outfits(group: CommandApp) -> None:
    @group.command("outfits")
    @command
    def outfits(
        folder: Folder,
        poses: Annotated[Path | None, typer.Option(help="A motion; without, the canonical pose.")] = None,
        frame: Annotated[int, typer.Option(help="Row of the motion; -1: the middle one.")] = -1,
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of sheet and report.")] = Path(
            "outfits"
        ),
        width: Pixels = None,
        height: Pixels = None,
        most: Annotated[int, typer.Option(min=1, help="Refuse more outfits than this.")] = 256,
        drive: Annotated[
            str, typer.Option(help="What moves garments: auto | bones | learned | simulated | own-size.")
        ] = "auto",
        as_json: Json = False,
    ) -> None:
        """Render every body in every set of garments that go together, on one sheet, and look for holes."""
        from stages.shared.outfit.wardrobe import pieces
        from stages.wardrobe.config import OutfitsConfig

        console = Console(as_json)
        base = OutfitsConfig()
        config = OutfitsConfig(frame, width or base.width, height or base.height, most=most, drive=drive)
        pieces(folder)  # refuses a missing folder
        check_poses([poses])

        console.loading()
        from stages.wardrobe import stage

        result = stage.run(folder, output, poses, config, console)
        console.result({"path": result.path, **result.summary})

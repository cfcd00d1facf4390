"""`gw tryon`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import (
    Background,
    Betas,
    DryRun,
    FilmFolder,
    FrameRate,
    Json,
    Passes,
    Penetration,
    Pixels,
    Preset,
    Rows,
    Swap,
    names,
    preset_config,
)
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("tryon")
    @command
    def tryon(
        poses: Annotated[Path, typer.Option(help="The motion: npz of SMPL-X or AMASS, or BVH.")],
        bundles: Annotated[
            list[Path] | None,
            typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="One body and its garments."),
        ] = None,
        wardrobe: Annotated[
            Path | None, typer.Option(help="Folder of bundles that --outfit chooses from.")
        ] = None,
        outfit: Annotated[
            str, typer.Option(help="Names in the wardrobe, a,b,c, or an outfit file (JSON).")
        ] = "",
        save_outfit: Annotated[
            Path | None, typer.Option(help="Also write an outfit file that names the bundles by digest.")
        ] = None,
        output: FilmFolder = Path("tryon"),
        betas: Betas = "",
        camera: Annotated[str, typer.Option(help="static | orbit.")] = "static",
        frames: Rows = "",
        fps: FrameRate = 0.0,
        width: Pixels = None,
        height: Pixels = None,
        background: Background = "white",
        passes: Passes = "",
        swap: Swap = True,
        restore: Annotated[
            bool, typer.Option(help="Let skin that clothes used to cover look like the skin around.")
        ] = True,
        push: Annotated[bool, typer.Option(help="Let garments give way where the body is larger.")] = False,
        penetration: Penetration = True,
        ground: Annotated[
            bool, typer.Option(help="Keep the feet on the floor when legs are longer or shorter.")
        ] = True,
        preset: Preset = "draft",
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Let a body wear garments of other people, in a new motion.

        Name the bundles, or choose them from a wardrobe: `--wardrobe DIR --outfit body,shirt,skirt`, or an
        outfit file, which finds its bundles by digest. Which garment lies over which follows from the layers
        (body < lower < upper < outer), not from the order they are named in. Garments take the wearer's
        shape. Frames have a transparent background.
        """
        from stages.tryon import stage
        from stages.tryon.config import PRESETS

        console = Console(as_json)
        bundles, file_betas = _bundles(bundles or [], wardrobe, outfit)
        betas = betas or file_betas
        base = preset_config(PRESETS, preset)
        config = replace(
            base,
            betas=betas,
            camera=camera,
            frames=frames,
            fps=fps,
            width=width or base.width,
            height=height or base.height,
            background=background,
            passes=names(passes),
            swap=swap,
            push=push,
            restore=restore,
            penetration=penetration,
            ground=ground,
        )
        if dry_run:
            console.plan(stage.plan(bundles, poses, output, config))
            return
        if save_outfit is not None:
            _save(save_outfit, bundles, betas)
        result = stage.run(bundles, poses, output, config, console)
        worn = " ".join(str(bundle) for bundle in bundles)
        console.result(
            {"path": result.path, **result.summary},
            next_command=f"gw render {worn} --poses {poses} --camera orbit -o render",
        )


def _bundles(given: list[Path], wardrobe: Path | None, outfit: str) -> tuple[list[Path], str]:
    """The bundles that are meant, and the shape that an outfit file asks for."""
    from stages.shared.outfit.wardrobe import chosen_pieces, open_outfit

    if bool(given) == bool(outfit) or (wardrobe is not None and not outfit):
        raise UsageProblem(
            "It is not clear what is worn.",
            "BUNDLES, --wardrobe, --outfit",
            "Name the bundles, or give --wardrobe DIR --outfit a,b,c, or --outfit FILE.json.",
        )
    if given:
        return given, ""
    if outfit.endswith(".json"):
        return open_outfit(Path(outfit), wardrobe)
    if wardrobe is None:
        raise UsageProblem(
            "There is no wardrobe to choose from.", "option --wardrobe", "Give --wardrobe DIR with --outfit."
        )
    return chosen_pieces(wardrobe, names(outfit)), ""


def _save(path: Path, bundles: list[Path], betas: str) -> None:
    from stages.shared.outfit.sources import parse_betas
    from stages.shared.outfit.wardrobe import save_outfit

    shape = parse_betas(betas)
    save_outfit(path, bundles, None if shape is None else shape.tolist())

"""`gw tryon`."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli import completion
from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.inputs import check_bundles, check_poses
from gw_cli.options import DryRun, FilmFolder, Json, names, without_shard
from stages.shared.errors import UsageProblem
from stages.shared.render_sequence.config import PRESETS, RenderConfig
from stages.shared.targets import check_file_target

_FPS_HELP = (
    "Frames per second; 0 keeps the motion's own. With --tradeoff frames must also be rendered that fast."
)


def register(app: typer.Typer) -> None:
    @app.command("tryon")
    @command
    @config_options(PRESETS, "draft", omit=("take", "distilled"), help={"fps": _FPS_HELP})
    def tryon(
        poses: Annotated[
            Path,
            typer.Option(
                help="The motion: npz of SMPL-X or AMASS, or BVH; or `canonical`: one frame in the pose of "
                "the maps."
            ),
        ],
        bundles: Annotated[
            list[Path] | None,
            typer.Argument(
                metavar="BODY.gwg GARMENT.gwg …",
                help="One body and its garments.",
                autocompletion=completion.bundles,
            ),
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
        tradeoff: Annotated[
            Path | None,
            typer.Option(
                metavar="FOLDER",
                help="A folder of `gw bench tradeoff`: wear its subject, at the point that --fps or "
                "--quality asks for.",
            ),
        ] = None,
        quality: Annotated[
            str,
            typer.Option(
                metavar="DB",
                help="With --tradeoff: the fastest point that is at most this many dB below the best.",
            ),
        ] = "",
        output: FilmFolder = Path("tryon"),
        config: RenderConfig = PRESETS["draft"],
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Let a body wear garments of other people, in a new motion.

        Name the bundles, or choose them from a wardrobe: `--wardrobe DIR --outfit body,shirt,skirt`, or an
        outfit file, which finds its bundles by digest. The layers decide which garment lies over which
        (body < lower < upper < outer), not the order of the names. Garments take the wearer's shape. Frames
        have a transparent background.

        With `--tradeoff FOLDER` no bundles are named: `--fps 25` wears the best-looking operating point that
        was measured to play at that rate, `--quality 0.3` the fastest at most 0.3 dB below the best one.
        The result states what that choice gives up.

        The same command continues a run that was killed. On many machines, use the same command with
        --shard 1/4 to --shard 4/4 and the same -o, and then once without --shard, which puts the parts
        together.
        """
        console = Console(as_json)
        chosen: dict[str, Any] = {}
        if tradeoff is not None or quality:
            _check_tradeoff(tradeoff, bundles, wardrobe, outfit)
            bundles, chosen = _operating_point(tradeoff, config.fps, quality)  # type: ignore[arg-type]
            console.say(chosen["given_up"])
        bundles, file_betas, file_drive = _bundles(bundles or [], wardrobe, outfit)
        drive = file_drive if config.drive == "auto" else config.drive
        config = replace(config, betas=config.betas or file_betas, drive=drive)
        if save_outfit is not None:
            check_file_target(save_outfit, "--save-outfit outfit.json")
        check_poses([poses])
        check_bundles(bundles)

        console.loading()
        from stages.tryon import stage

        if dry_run:
            console.plan(stage.plan(bundles, poses, output, config))
            return
        if save_outfit is not None:
            _save(save_outfit, bundles, config.betas, config.drive)
        result = stage.run(bundles, poses, output, config, console)
        shown = {"path": result.path, **chosen, **result.summary}
        if not result.complete:
            console.result(shown, without_shard(sys.argv), when="when all parts are done")
            return
        film = result.summary.get("video")
        following: tuple[str | Path, ...] = ("gw", "view", *bundles, "--poses", poses, "--open")
        console.result(shown, following, watch=result.path / str(film) if film else None)


def _check_tradeoff(
    tradeoff: Path | None, bundles: list[Path] | None, wardrobe: Path | None, outfit: str
) -> None:
    """Raise where --tradeoff and --quality contradict the other options."""
    if tradeoff is None:
        raise UsageProblem(
            "There is nothing measured to choose from.",
            "option --quality",
            "Give the folder of gw bench tradeoff: --tradeoff FOLDER.",
        )
    if bundles or wardrobe is not None or outfit:
        raise UsageProblem(
            "It is not clear what is worn.",
            "BUNDLES, --wardrobe, --outfit, --tradeoff",
            "With --tradeoff the bundles are those of the operating point: name no others.",
        )


def _operating_point(folder: Path, fps: float, quality: str) -> tuple[list[Path], dict[str, Any]]:
    """The bundles of the point that is asked for, and what to say about it."""
    from stages.workflows.tradeoff.front import chosen_point, given_up
    from stages.workflows.tradeoff.stage import bundles_of, read_points

    points = read_points(folder)
    point = chosen_point(points, fps, _decibels(quality) if quality else None)
    facts = {
        "operating_point": point.name,
        "measured_frames_per_second": point.frames_per_second,
        "given_up": given_up(points, point),
    }
    return bundles_of(folder, point), facts


def _decibels(text: str) -> float:
    """ "0.3", "0.3dB" or "0.3 dB"."""
    try:
        loss = float(text.strip().lower().removesuffix("db"))
    except ValueError:
        loss = -1.0
    if not 0 <= loss < math.inf:
        raise UsageProblem(
            f"{text!r} is not a loss of quality.", "option --quality", "Give decibels, as 0.3."
        )
    return loss


def _bundles(named: list[Path], wardrobe: Path | None, outfit: str) -> tuple[list[Path], str, str]:
    """The bundles that are meant, and the shape and the drive that an outfit file asks for."""
    from stages.shared.outfit.wardrobe import chosen_pieces, open_outfit

    if bool(named) == bool(outfit) or (wardrobe is not None and not outfit):
        raise UsageProblem(
            "It is not clear what is worn.",
            "BUNDLES, --wardrobe, --outfit",
            "Name the bundles, or give --wardrobe DIR --outfit a,b,c, or --outfit FILE.json.",
        )
    if named:
        return named, "", "auto"
    if outfit.endswith(".json"):
        return open_outfit(Path(outfit), wardrobe)
    if wardrobe is None:
        raise UsageProblem(
            "There is no wardrobe to choose from.", "option --wardrobe", "Give --wardrobe DIR with --outfit."
        )
    return chosen_pieces(wardrobe, names(outfit)), "", "auto"


def _save(path: Path, bundles: list[Path], betas: str, drive: str) -> None:
    from stages.shared.outfit.sources import parse_betas
    from stages.shared.outfit.wardrobe import save_outfit

    shape = parse_betas(betas)
    save_outfit(path, bundles, None if shape is None else shape.tolist(), drive)

"""`gw import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    @app.command("import")
    @command
    def import_capture(
        source: Annotated[
            Path, typer.Argument(help="Folder with a video, a folder of pictures or a picture a camera.")
        ],
        output: Annotated[
            Path, typer.Option("--output", "-o", help="Folder of the capture that is written.")
        ],
        calibration: Annotated[
            Path | None, typer.Option(help="Calibration file or folder; default: looked for in SOURCE.")
        ] = None,
        masks: Annotated[str, typer.Option(help="auto | folder | alpha | background | network.")] = "auto",
        background: Annotated[
            Path | None, typer.Option(help="Picture, video or folder of the empty scene.")
        ] = None,
        up: Annotated[
            str, typer.Option(help="Axis that points up: auto | +x | -x | +y | -y | +z | -z.")
        ] = "auto",
        metres_per_unit: Annotated[
            float | None, typer.Option(help="Length of the calibration's unit, 0.001 for millimetres.")
        ] = None,
        fps: Annotated[
            float | None, typer.Option(help="Frames per second; default: the videos' own.")
        ] = None,
        frames: Annotated[str, typer.Option(help="Only these frames, as a slice: 10:200:2.")] = "",
        test_frames: Annotated[
            int, typer.Option(min=0, help="The last so many frames become a test take.")
        ] = 0,
        offset: Annotated[
            list[str] | None,
            typer.Option(help="CAMERA=SECONDS by which its recording begins later; may be repeated."),
        ] = None,
        held_out: Annotated[str, typer.Option(help="Cameras for judging only: cam03,cam07.")] = "",
        take: Annotated[str, typer.Option(help="Name of the take.")] = "take",
        alpha: Annotated[
            float,
            typer.Option(min=0, max=1, help="Undistortion: 0 keeps valid pixels only, 1 all of the picture."),
        ] = 0.0,
        refine_cameras: Annotated[
            bool, typer.Option("--refine-cameras", help="Improve the cameras' poses by body landmarks.")
        ] = False,
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Make a capture of videos or pictures and a calibration.

        Lens distortion is removed, the world is brought to metres and y up, and masks are made where there
        are none. Look at CAPTURE/contact_sheet.png: it shows the cameras and a picture of each with its
        mask.
        """
        console = Console(as_json)
        console.loading()
        from stages.import_capture import stage
        from stages.import_capture.config import ImportConfig

        config = ImportConfig(
            take=take,
            fps=fps,
            frames=_slice(frames),
            test_frames=test_frames,
            offsets=dict(_offset(text) for text in offset or ()),
            held_out=tuple(name.strip() for name in held_out.split(",") if name.strip()),
            up=up,
            metres_per_unit=metres_per_unit,
            alpha=alpha,
            masks=masks,
            background=background,
            refine_cameras=refine_cameras,
        )
        if dry_run:
            console.plan(stage.plan(source, output, config, calibration))
            return
        result = stage.run(source, output, config, console, calibration)
        console.result(
            result.summary, next_command=("gw", "register-template", output, "-o", "SUBJECT", "--fit")
        )


def _slice(text: str) -> tuple[int, int | None, int]:
    parts = text.split(":")
    try:
        values = [int(part) if part else None for part in parts] + [None] * (3 - len(parts))
        start, stop, step = values[0] or 0, values[1], values[2] or 1
        if len(parts) > 3 or start < 0 or step < 1 or (stop is not None and stop <= start):
            raise ValueError(text)
    except ValueError as error:
        raise UsageProblem("This is no slice of frames.", f"--frames {text}", "Write 10:200:2.") from error
    return start, stop, step


def _offset(text: str) -> tuple[str, float]:
    name, _, seconds = text.rpartition("=")
    try:
        return name, float(seconds)
    except ValueError as error:
        raise UsageProblem("This is no offset.", f"--offset {text}", "Write cam02=0.35.") from error

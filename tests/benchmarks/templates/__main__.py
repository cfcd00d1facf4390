"""`python -m tests.benchmarks.templates`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console
from gw_cli.options import Json, Preset
from tests.benchmarks.command import application


def templates(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of a capture.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the workspace, the rows and the table.")
    ] = Path("bench_templates"),
    body_model: Annotated[
        Path | None, typer.Option(help="Body model of the poses; default: the capture's.")
    ] = None,
    fit: Annotated[
        bool, typer.Option(help="Also fit the body to the first scan without its parameters.")
    ] = True,
    camera_step: Annotated[int, typer.Option(min=1, help="Every so many-th camera of test takes.")] = 1,
    frame_step: Annotated[int, typer.Option(min=1, help="Every so many-th filmed test frame.")] = 1,
    preset: Preset = "draft",
    as_json: Json = False,
) -> None:
    """Measure a capture's template against the truth that the capture carries.

    Runs register-template, canonicalize, segment-layers and bake-maps, and compares: the body fit
    without given parameters, posing and shaping back, vertex labels with the scan's, what the maps miss,
    silhouettes and stretch of the layers moved by bones alone in the test takes, time and memory. Rows
    that the capture has no truth for say why.
    """
    from tests.benchmarks.templates import stage
    from tests.benchmarks.templates.config import BenchTemplatesConfig

    console = Console(as_json)
    config = BenchTemplatesConfig(preset, fit, camera_step, frame_step)
    result = stage.run(capture, output, config, console, body_model)
    if as_json:
        console.result({"path": result.path, **result.summary})
        return
    console.say((result.path / "table.md").read_text())
    console.result({"path": result.path, "met": result.summary["met"], "missed": result.summary["missed"]})


app = application(templates)

if __name__ == "__main__":
    app()

"""`gw bench precision`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json


def register(bench: typer.Typer) -> None:
    @bench.command("precision")
    @command
    def precision(
        bundles: Annotated[
            list[Path],
            typer.Argument(metavar="BODY.gwg GARMENT.gwg …", help="Exported with --precision float32."),
        ],
        poses: Annotated[Path, typer.Option(help="The motion it is judged in.")],
        output: Annotated[Path, typer.Option("-o", "--output", help="JSON file.")] = Path("precision.json"),
        frames: Annotated[int, typer.Option(min=1, help="How many frames of the motion.")] = 6,
        as_json: Json = False,
    ) -> None:
        """Measure what 16 bits cost in a bundle: for each kind of tensor bytes saved and dB lost."""
        from stages.bench_precision import stage
        from stages.bench_precision.config import BenchPrecisionConfig

        console = Console(as_json)
        result = stage.run(bundles, poses, output, BenchPrecisionConfig(frames=frames), console)
        console.result({"path": result.path, **result.summary})

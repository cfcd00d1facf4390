"""`gw bench paper`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.options import Json
from stages.evaluate.config import EvaluateConfig

_VIEWS = EvaluateConfig(methods=("trained",), pictures=2)


def register(bench: typer.Typer) -> None:
    @bench.command("paper")
    @command
    @config_options({"views": _VIEWS}, omit=("methods", "training", "drive", "shard"))
    def paper(
        subjects: Annotated[
            list[Path], typer.Argument(metavar="SUBJECT…", help="Workspaces with trainings of gw train.")
        ],
        output: Annotated[
            Path, typer.Option("-o", "--output", help="Folder for paper.md, paper.json and every evaluation.")
        ] = Path("bench_paper"),
        config: EvaluateConfig = _VIEWS,
        perceptual_weights: Annotated[
            Path | None,
            typer.Option(metavar="FILE", help="VGG-16 and LPIPS weights; without, lpips is null."),
        ] = None,
        as_json: Json = False,
    ) -> None:
        """Print the paper's three tables with the published values and your own trainings.

        Every training of a subject is a row: methods of gw train --method, ablations of gw train --without.
        gw bench curves trains them. Compare trainings of the same preset and --minutes, which are listed
        together. Scores leave out the first test frame, which is often the pose of the template. Finished
        evaluations are used again.
        """
        console = Console(as_json)
        console.loading()
        from stages.shared.artifacts.files import make_folders, write_whole
        from stages.workflows.paper.tables import markdown, tables
        from stages.workflows.paper.trainings import own_rows

        rows = [
            row
            for subject in subjects
            for row in own_rows(subject, output / subject.resolve().name, config, console, perceptual_weights)
        ]
        content = tables(rows)
        text = markdown(content)
        make_folders(output)
        write_whole(output / "paper.md", text.encode())
        write_whole(output / "paper.json", json.dumps(content, indent=1).encode())
        if as_json:
            console.result({"path": output, **content})
        else:
            typer.echo(text)

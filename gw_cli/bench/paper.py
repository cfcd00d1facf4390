"""`gw bench paper`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json, names


def register(bench: typer.Typer) -> None:
    @bench.command("paper")
    @command
    def paper(
        subjects: Annotated[
            list[Path], typer.Argument(metavar="SUBJECT…", help="Workspaces with trainings of gw train.")
        ],
        output: Annotated[
            Path, typer.Option("-o", "--output", help="Folder for paper.md, paper.json and every evaluation.")
        ] = Path("bench_paper"),
        split: Annotated[
            str, typer.Option(help="Of novel-pose, novel-view; what the capture has.")
        ] = "novel-pose,novel-view",
        frame_step: Annotated[int, typer.Option(min=1, help="Novel views: every so many-th frame.")] = 5,
        test_frame_step: Annotated[int, typer.Option(min=1, help="Novel poses: every so many-th frame.")] = 1,
        cameras: Annotated[
            int, typer.Option(min=0, help="At most so many cameras of each frame; 0: all.")
        ] = 0,
        perceptual_weights: Annotated[
            Path | None,
            typer.Option(metavar="FILE", help="VGG-16 and LPIPS weights; without, lpips is null."),
        ] = None,
        as_json: Json = False,
    ) -> None:
        """Print the paper's three tables with your own trainings beside the published values.

        Every training of a subject is a row: methods of gw train --method, ablations of gw train --without;
        gw bench curves trains them. Compare those of the same preset and --minutes: they stand together.
        Scores leave out the first test frame, often the pose of the template. What is evaluated already is
        not done again.
        """
        from stages.evaluate.config import EvaluateConfig
        from stages.shared.artifacts.files import make_folders, write_whole
        from stages.workflows.paper.tables import markdown, tables
        from stages.workflows.paper.trainings import own_rows

        console = Console(as_json)
        config = EvaluateConfig(
            splits=names(split),
            methods=("trained",),
            frame_step=frame_step,
            test_frame_step=test_frame_step,
            cameras=cameras,
            pictures=2,
        )
        rows = [
            row
            for subject in subjects
            for row in own_rows(subject, output / subject.resolve().name, config, console, perceptual_weights)
        ]
        found = tables(rows)
        text = markdown(found)
        make_folders(output)
        write_whole(output / "paper.md", text.encode())
        write_whole(output / "paper.json", json.dumps(found, indent=1).encode())
        if as_json:
            console.result({"path": output, **found})
        else:
            typer.echo(text)

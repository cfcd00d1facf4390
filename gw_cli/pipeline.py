"""`gw pipeline`: the stages as a workflow for many subjects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json, Preset


def register(app: typer.Typer) -> None:
    @app.command("pipeline")
    @command
    def pipeline(
        captures: Annotated[
            list[Path] | None, typer.Argument(help="Folders of captures.", metavar="CAPTURE …")
        ] = None,
        emit: Annotated[
            str | None, typer.Option(help="snakefile: write a workflow instead of listing the stages.")
        ] = None,
        workspaces: Annotated[Path, typer.Option(help="Folder of the subjects' workspaces.")] = Path(
            "subjects"
        ),
        output: Annotated[Path, typer.Option("-o", "--output", help="File to write.")] = Path("Snakefile"),
        preset: Preset = "draft",
        as_json: Json = False,
    ) -> None:
        """List the stages in order, or write them as a Snakefile for many subjects and a cluster.

        `gw pipeline CAPTURE... --emit snakefile` makes one rule a stage, one job a subject and stage; run it
        with `snakemake --cores 2`, or on Slurm (docs/scale.md). Without --emit, nothing is written.
        """
        from stages.pipeline import PIPELINE
        from stages.shared.artifacts import write_whole
        from stages.shared.errors import UsageProblem
        from stages.workflows.snakefile import snakefile, subjects

        console = Console(as_json)
        if emit is None:
            stages = [{"stage": s.name, "command": s.command, "reads": list(s.reads)} for s in PIPELINE]
            if as_json:
                console.result({"stages": stages})
                return
            for spec in PIPELINE:
                console.say(f"{spec.command:45} reads {', '.join(spec.reads) or 'the capture'}")
            return
        if emit != "snakefile":
            raise UsageProblem(
                f"No workflow of kind {emit!r} is known.", "option --emit", "Write: snakefile."
            )
        if not captures:
            raise UsageProblem(
                "A workflow needs captures.", "gw pipeline", "Name at least one capture folder."
            )
        named = subjects(captures)
        write_whole(output, snakefile(named, workspaces.as_posix(), preset).encode())
        console.result(
            {"file": output, "subjects": sorted(named), "jobs": len(named) * len(PIPELINE)},
            next_command=("snakemake", "--snakefile", output, "--cores", "2"),
        )

"""`gw bench paper`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

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
        from stages.bench_paper.tables import markdown, tables
        from stages.evaluate.config import EvaluateConfig
        from stages.shared.artifacts.files import make_folders, write_whole

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
            for row in _rows(subject, output / subject.resolve().name, config, console, perceptual_weights)
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


def _rows(subject: Path, folder: Path, config: Any, console: Console, weights: Path | None) -> list[Any]:
    """Evaluate every training of a subject that is not evaluated yet."""
    from dataclasses import replace

    from stages.bench_paper.tables import OwnRow
    from stages.bench_paper.trainings import method_of, trainings, without_of
    from stages.evaluate import stage
    from stages.shared.artifacts import Workspace

    rows = []
    for artifact in trainings(Workspace(subject)):
        method, without = method_of(artifact), without_of(artifact)
        console.say(f"{subject.name}: {method}" + (f" without {', '.join(without)}" if without else ""))
        own = replace(config, training=artifact.key)
        place = folder / artifact.key[:12]
        summary = _evaluated(place, own, weights)
        if summary is None:
            summary = stage.run(subject, place, own, console, weights).summary
        seconds = artifact.run.get("training_seconds")
        scores: dict[str, dict[str, float | None]] = {}
        for name in ("novel_pose", "novel_view"):
            if name in summary:
                scores[name] = summary[name].get("trained_without_first", summary[name]["trained"])
        minutes = seconds / 60 if seconds is not None else None
        steps, budget = artifact.summary.get("steps"), artifact.manifest.config.get("minutes")
        name = subject.resolve().name
        rows.append(OwnRow(name, artifact.key, method, without, minutes, steps, scores, budget))
    return rows


def _evaluated(place: Path, config: Any, weights: Path | None) -> dict[str, Any] | None:
    """What an earlier run with the same settings wrote."""
    from stages.shared.artifacts.canonical import plain
    from stages.shared.artifacts.external import file_digest

    try:
        content = json.loads((place / "evaluation.json").read_bytes())
    except (OSError, ValueError):
        return None
    same = content.get("config") == plain(config)
    same = same and content.get("perceptual_digest") == (file_digest(weights) if weights else None)
    return content if same else None

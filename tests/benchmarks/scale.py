"""What a wardrobe of many garments on many bodies would cost, from the run records of real subjects.

On paper: nothing is run. A subject is one person in one set of clothes; it gives one body and its garments.
Then every garment is worn by every body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli.console import Console
from gw_cli.options import Json
from stages.pipeline import PIPELINE
from stages.shared.artifacts import Workspace
from stages.shared.errors import BadData
from tests.benchmarks.command import application


@dataclass(frozen=True)
class ScaleConfig:
    """How many garments and bodies, and how many machines.

    Attributes:
        garments, bodies: how many. garments_per_subject: that one capture gives.
        tryon_seconds: of one garment on one body, as measured. bundle_bytes: of one bundle.
        machines: that work at once.
    """

    garments: int = 1000
    bodies: int = 100
    garments_per_subject: float = 2.0
    tryon_seconds: float = 60.0
    bundle_bytes: int = 15_000_000
    machines: int = 50


@dataclass(frozen=True)
class StageCost:
    """What one subject took in one stage: median seconds, most memory, bytes kept, over `records` records."""

    stage: str
    seconds: float
    peak_bytes: int
    kept_bytes: int
    records: int


def stage_costs(subjects: Sequence[Path]) -> list[StageCost]:
    """From the run records of the artifacts in use.

    Raises:
        MissingInput: a stage was not run for a subject. BadData: a record does not say how long it took.
    """
    costs = []
    for spec in PIPELINE:
        found = [Workspace(subject).require(spec) for subject in subjects]
        seconds = [_seconds(artifact.run, str(artifact.path)) for artifact in found]
        kept = [sum(entry.bytes for entry in artifact.manifest.files.values()) for artifact in found]
        costs.append(
            StageCost(
                spec.name,
                sorted(seconds)[len(seconds) // 2],
                max(int(artifact.run["peak_bytes"]) for artifact in found),
                max(kept),
                len(found),
            )
        )
    return costs


def _seconds(record: dict[str, Any], where: str) -> float:
    """Whole time of a stage; a training that was interrupted and resumed counts all of its parts."""
    if "stage_seconds" not in record:
        raise BadData(
            "The run record does not say how long the stage took.", where, "Run it again with --force."
        )
    return max(float(record["stage_seconds"]), float(record.get("training_seconds", 0.0)))


def simulate(costs: Sequence[StageCost], config: ScaleConfig) -> dict[str, Any]:
    """Machine hours, and gigabytes of learning all garments and of trying each on every body."""
    captures = max(config.garments / config.garments_per_subject, config.bodies)
    learning = captures * sum(cost.seconds for cost in costs) / 3600
    wearing = config.garments * config.bodies * config.tryon_seconds / 3600
    kept = captures * sum(cost.kept_bytes for cost in costs)
    bundles = (config.garments + config.bodies) * config.bundle_bytes
    hours = learning + wearing
    return {
        "captures": round(captures),
        "learning_hours": learning,
        "tryon_hours": wearing,
        "machine_hours": hours,
        "wall_hours": hours / config.machines,
        "artifact_gigabytes": kept / 1e9,
        "bundle_gigabytes": bundles / 1e9,
        "most_memory_gigabytes": max(cost.peak_bytes for cost in costs) / 1e9,
    }


def table(costs: Sequence[StageCost], config: ScaleConfig, result: dict[str, Any]) -> str:
    """Markdown of the measured stages and of what follows from them."""
    lines = ["| stage | seconds a subject | peak memory, GB | kept, MB |", "| --- | --- | --- | --- |"]
    lines += [
        f"| {c.stage} | {c.seconds:.1f} | {c.peak_bytes / 1e9:.2f} | {c.kept_bytes / 1e6:.1f} |"
        for c in costs
    ]
    lines += [
        "",
        f"{config.garments} garments × {config.bodies} bodies from {result['captures']} captures "
        f"({config.garments_per_subject:g} garments each), {config.machines} machines of two cores, "
        f"{config.tryon_seconds:g} s a try-on:",
        "",
        "| | |",
        "| --- | --- |",
    ]
    lines += [f"| {name.replace('_', ' ')} | {value:.4g} |" for name, value in result.items()]
    return "\n".join(lines) + "\n"


def scale(
    subjects: Annotated[
        list[Path],
        typer.Argument(help="Trained subjects whose run records are read.", metavar="SUBJECT..."),
    ],
    garments: Annotated[int, typer.Option(min=1, help="How many garments.")] = 1000,
    bodies: Annotated[int, typer.Option(min=1, help="How many bodies.")] = 100,
    per_subject: Annotated[float, typer.Option(min=0.1, help="Garments that one capture gives.")] = 2.0,
    tryon_seconds: Annotated[float, typer.Option(min=0, help="Of one garment on one body.")] = 60.0,
    machines: Annotated[int, typer.Option(min=1, help="That work at once.")] = 50,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Markdown file of the tables.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Estimate hours and gigabytes of many garments on many bodies, from measured stages.

    Reads what every stage of the given subjects took from their run records; nothing is run. The time of
    a try-on is what `gw tryon` of your length takes.
    """
    from dataclasses import asdict

    from stages.shared.artifacts import write_whole

    console = Console(as_json)
    config = ScaleConfig(
        garments, bodies, per_subject, tryon_seconds, machines=machines
    )  # the size of a bundle is that of the demo's
    costs = stage_costs(subjects)
    result = simulate(costs, config)
    if output is not None:
        write_whole(output, table(costs, config, result).encode())
    stages = {cost.stage: asdict(cost) if as_json else f"{cost.seconds:.1f} s" for cost in costs}
    console.result({"stages": stages, **result})


app = application(scale)

if __name__ == "__main__":
    app()

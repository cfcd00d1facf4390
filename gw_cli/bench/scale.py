"""`gw bench scale`: many garments on many bodies, on paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json


def register(bench: typer.Typer) -> None:
    @bench.command("scale")
    @command
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
        price: Annotated[float, typer.Option(min=0, help="Of one machine for an hour.")] = 0.1,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Markdown file of the tables.")
        ] = None,
        as_json: Json = False,
    ) -> None:
        """Reckon hours, gigabytes and cost of many garments on many bodies, from measured stages.

        Reads what every stage of the given subjects took from their run records; nothing is run. The time of
        a try-on is what `gw tryon` of your length takes.
        """
        from dataclasses import asdict

        from stages.shared.artifacts import write_whole
        from stages.workflow.scale import ScaleConfig, simulate, stage_costs, table

        console = Console(as_json)
        config = ScaleConfig(
            garments, bodies, per_subject, tryon_seconds, machines=machines, price=price
        )  # the size of a bundle is that of the demo's
        costs = stage_costs(subjects)
        result = simulate(costs, config)
        if output is not None:
            write_whole(output, table(costs, config, result).encode())
        stages = {cost.stage: asdict(cost) if as_json else f"{cost.seconds:.1f} s" for cost in costs}
        console.result({"stages": stages, **result})

"""`python -m tests.benchmarks.stability`: errors of the numerical functions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console
from gw_cli.options import Json, Seed, names
from tests.benchmarks.command import application


def stability(
    families: Annotated[
        str, typer.Option(help="Only these families of functions, with commas; all by default.")
    ] = "",
    seed: Seed = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for stability.json and stability.md.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure how errors grow with the size of the input, in float64, float32 and bfloat16.

    Every public numerical function (rotations, skinning, sampling, projection, splatting, normals,
    losses, bundles) on inputs from nothing to absurd: the error against float64, or the refusal. Ends
    with exit code 70 if any result is neither finite nor refused.
    """
    from stages.shared.errors import GwError
    from tests.benchmarks.stability.config import StabilityConfig
    from tests.benchmarks.stability.stage import run, summary

    console = Console(as_json)
    found = summary(run(output, StabilityConfig(names(families), seed), console))
    console.result(found)
    if found["defects"]:
        raise GwError(
            f"{found['not_finite']} results are neither finite nor refused.",
            "; ".join(found["defects"]),
            "Please file a report with this list.",
        )


app = application(stability)

if __name__ == "__main__":
    app()

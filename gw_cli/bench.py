"""`gw bench`: how fast this machine is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console, command
from gw_cli.options import Json
from stages.shared.errors import UsageProblem


def register(app: typer.Typer) -> None:
    bench = typer.Typer(help="Measure this machine.", no_args_is_help=True)
    app.add_typer(bench, name="bench")

    @bench.callback()
    def group() -> None:
        """Measure this machine."""

    @bench.command("splat")
    @command
    def splat(
        gaussians: Annotated[
            str, typer.Option(help="How many, with commas; k is thousand.")
        ] = "25k,50k,100k,200k",
        sizes: Annotated[str, typer.Option(help="Sides of the square pictures in px, with commas.")] = "512",
        channels: Annotated[str, typer.Option(help="Features per Gaussian, with commas.")] = "3",
        rounds: Annotated[
            int, typer.Option(min=1, help="Repetitions; medians and least times are kept.")
        ] = 9,
        threads: Annotated[int, typer.Option(min=0, help="0: as many as torch uses.")] = 0,
        output: Annotated[
            Path | None, typer.Option("-o", "--output", help="Folder for splat.json and charts.")
        ] = None,
        as_json: Json = False,
    ) -> None:
        """Time the Gaussian rasteriser, and compare it with what this machine can do at best.

        Every combination is measured on a standing figure: forward, forward and backward, phases, blended
        pairs per second, share of the vector lanes used, memory, and the fraction reached of two limits: the
        peak of the vector units, and the blending steps at their cost in the first-level cache.
        """
        from stages.shared.splat.benchmark.run import BenchConfig, run

        console = Console(as_json)
        config = BenchConfig(
            _numbers("gaussians", gaussians),
            _numbers("sizes", sizes),
            _numbers("channels", channels),
            rounds,
            threads,
        )
        result = run(output, config, console)
        summary = result.summary
        if as_json:
            console.result(summary)
            return
        shown = {name: summary[name] for name in ("machine", "threads", "first_call", "limit", "cuda")}
        shown["times faster than the reference"] = summary["times_faster_than_reference"]
        shown["files"] = [str(path) for path in result.files]
        console.result(shown)


def _numbers(option: str, text: str) -> tuple[int, ...]:
    """'25k,50k' -> (25000, 50000)."""
    try:
        return tuple(
            int(float(word.rstrip("kK")) * (1000 if word[-1:] in "kK" else 1)) for word in text.split(",")
        )
    except (ValueError, OverflowError):
        raise UsageProblem(
            f"{text!r} is not a list of numbers.", f"option --{option}", "Write for example 25k,50k."
        ) from None

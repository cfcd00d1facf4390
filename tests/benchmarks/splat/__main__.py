"""`python -m tests.benchmarks.splat`: the speed of the Gaussian rasteriser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console
from gw_cli.options import Json
from stages.shared.errors import UsageProblem
from tests.benchmarks.command import application


def splat(
    gaussians: Annotated[str, typer.Option(help="How many, with commas; k is thousand.")] = "25k,100k,400k",
    sizes: Annotated[
        str, typer.Option(help="Sides of the square pictures in px, with commas.")
    ] = "256,512,1024,2048",
    channels: Annotated[str, typer.Option(help="Features per Gaussian, with commas.")] = "3,7",
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions; medians and least times are kept.")] = 5,
    threads: Annotated[int, typer.Option(min=0, help="0: as many as torch uses.")] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Seconds instead of minutes: a few small cases only.")
    ] = False,
    cold: Annotated[bool, typer.Option(help="Also time a first call that must compile the kernels.")] = True,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for splat.json and charts.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Time the Gaussian rasteriser, and compare it with what this machine can do at best.

    Every combination is measured on a standing figure: forward, forward and backward, phases, blended
    pairs per second, share of the vector lanes used, memory (buffers, and the peak of the process), and
    the fraction reached of two limits: the peak of the vector units, and the blending steps at their cost
    in the first-level cache. Also: the first call in a new process, with compiled kernels on disk and
    without; the reference backend, and gsplat's projection in torch where gsplat is installed.

    Some minutes on a quiet machine; --quick takes seconds. Charts are written with --output.
    """
    from tests.benchmarks.splat.run import BenchConfig, run

    console = Console(as_json)
    config = BenchConfig(
        numbers("gaussians", gaussians),
        numbers("sizes", sizes),
        numbers("channels", channels),
        rounds,
        threads,
        cold,
    )
    if quick:
        config = config.quick()
    result = run(output, config, console)
    summary = result.summary
    if as_json:
        console.result(summary)
        return
    shown = {name: summary[name] for name in ("machine", "threads", "first_call", "limit", "cuda")}
    shown["times faster than the reference"] = summary["times_faster_than_reference"]
    gsplat = summary["times_faster_than_gsplat_torch"]
    shown["times faster than gsplat's torch reference"] = gsplat or summary["gsplat_torch"]["skipped"]
    shown["files"] = [str(path) for path in result.files]
    console.result(shown)


def numbers(option: str, text: str) -> tuple[int, ...]:
    """'25k,50k' -> (25000, 50000). Raises UsageProblem for anything else."""
    try:
        return tuple(
            int(float(word.rstrip("kK")) * (1000 if word[-1:] in "kK" else 1)) for word in text.split(",")
        )
    except (ValueError, OverflowError):
        raise UsageProblem(
            f"{text!r} is not a list of numbers.", f"option --{option}", "Write for example 25k,50k."
        ) from None


app = application(splat)

if __name__ == "__main__":
    app()

"""`python -m tests.benchmarks.tryon`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gw_cli.console import Console
from gw_cli.options import Json, names
from stages.shared.errors import UsageProblem
from tests.benchmarks.command import application


def tryon(
    sources: Annotated[
        list[Path], typer.Argument(metavar="DEMO | BODY.gwg GARMENT.gwg …", help="A demo, or an outfit.")
    ],
    truth: Annotated[
        Path | None, typer.Option(help="A capture of that body in those garments; the demo's own.")
    ] = None,
    poses: Annotated[Path | None, typer.Option(help="The motion of the truth; the demo's own.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder; default: DEMO/bench_tryon.")
    ] = None,
    variants: Annotated[str, typer.Option(help="Only these, e.g. none,swap,all.")] = "",
    region: Annotated[
        str, typer.Option(help="Layer scored by itself; default: the garment that is another person's.")
    ] = "",
    frame_step: Annotated[int, typer.Option(min=1, help="Every so many-th frame.")] = 1,
    camera_step: Annotated[int, typer.Option(min=1, help="Every so many-th camera.")] = 1,
    as_json: Json = False,
) -> None:
    """Measure what each part of try-on is worth: body swap, push-out and penetration pass.

    An outfit is rendered with and without each of them and scored against a capture that shows the
    truth: the body in the garments of another person, as simulated by gw synth.
    """
    from tests.benchmarks.tryon import stage
    from tests.benchmarks.tryon.config import BenchTryonConfig

    console = Console(as_json)
    bundles = sources
    if len(sources) == 1 and sources[0].is_dir():
        bundles, own_poses, own_truth = stage.demo_inputs(sources[0])
        poses, truth = poses or own_poses, truth or own_truth
        output = output or sources[0] / "bench_tryon"
    if poses is None or truth is None:
        raise UsageProblem(
            "There is nothing to compare with.",
            "options --poses and --truth",
            "Give the motion and a capture of the truth, or the folder of a demo.",
        )
    base = BenchTryonConfig(region=region, frame_step=frame_step, camera_step=camera_step)
    config = BenchTryonConfig(
        names(variants) or base.variants, base.region, base.frame_step, base.camera_step
    )
    result = stage.run(bundles, poses, truth, output or Path("bench_tryon"), config, console)
    console.result({"path": result.path, **result.summary})


app = application(tryon)

if __name__ == "__main__":
    app()

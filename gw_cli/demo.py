"""`gw demo`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from gw_cli.config_options import config_options
from gw_cli.console import Console, command
from gw_cli.options import DryRun, Json
from stages.workflows.demo.recipe import PRESETS, DemoConfig


def register(app: typer.Typer) -> None:
    @app.command("demo")
    @command
    @config_options(PRESETS, "draft")
    def demo(
        output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the demo.")] = Path("demo"),
        config: DemoConfig = PRESETS["draft"],
        dry_run: DryRun = False,
        as_json: Json = False,
    ) -> None:
        """Synthesise two subjects, learn both, and let one wear the other's skirt.

        Needs no input and no network. Every step is an ordinary `gw` command, shown on the page
        `index.html` in the output folder with its pictures, scores and timings. The two subjects are
        learned at the same time. Steps that are done are not run again.
        """
        from stages.shared.device import check_device

        console = Console(as_json)
        check_device(config.device)

        console.loading()
        from gw_cli.child import run_command
        from stages.workflows.demo import stage

        if dry_run:
            console.plan(stage.plan(output, config))
            return
        result = stage.run(output, config, run_command, console)
        shown = dict(result.summary)
        if not as_json:  # all scores are on the page
            for line in _scores(shown.pop("scores")):
                console.say(line)
        console.result(shown, watch=result.page)


def _scores(evaluations: dict[str, Any]) -> Iterator[str]:
    """A line per evaluation and split: foreground PSNR of the trained subject and of the baseline."""
    for title, splits in evaluations.items():
        for split, means in splits.items():
            rows = means if isinstance(means, dict) and "psnr_foreground" not in means else {"": means}
            values = [
                f"{method} {scores['psnr_foreground']:.2f} dB".strip()
                for method, scores in rows.items()
                if isinstance(scores, dict) and scores.get("psnr_foreground") is not None
            ]
            if values:
                yield f"{title}, {split.replace('_', ' ')}: {', '.join(values).replace('_', ' ')}"

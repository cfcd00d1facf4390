"""Options that commands share, each said once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

import typer

from stages.shared.errors import UsageProblem

Config = TypeVar("Config")

Subject = Annotated[Path, typer.Argument(help="Workspace folder of the subject.", metavar="SUBJECT")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object a line on stdout; people's text off.")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Show inputs, outputs, configuration and cost; write nothing.")
]
Preset = Annotated[str, typer.Option(help="tiny | draft | balanced | paper: how much to spend.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.")]
Device = Annotated[str, typer.Option(help="auto | cpu | cuda.")]
Force = Annotated[bool, typer.Option("--force", help="Do it again though it is up to date.")]


def preset_config(presets: dict[str, Config], name: str) -> Config:
    """The preset called `name`, or a usage error that lists the ones there are."""
    if name not in presets:
        raise UsageProblem(
            f"There is no preset called {name!r}.",
            "option --preset",
            "Choose one of: " + ", ".join(presets) + ".",
        )
    return presets[name]

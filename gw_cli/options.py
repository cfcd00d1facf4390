"""Options that several commands have, and the parsing of their values."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from gw_cli import completion
from gw_cli.help import GENERAL
from stages.shared.errors import UsageProblem

Config = TypeVar("Config")

Subject = Annotated[
    Path,
    typer.Argument(
        help="Workspace folder of the subject.", metavar="SUBJECT", autocompletion=completion.subjects
    ),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print JSON objects on stdout, one per line, instead of text for people.",
        rich_help_panel=GENERAL,
    ),
]
Verbose = Annotated[
    bool,
    typer.Option("-v", "--verbose", help="Also print digests and long lists.", rich_help_panel=GENERAL),
]
DryRun = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Show inputs, outputs, configuration and cost; write nothing.",
        rich_help_panel=GENERAL,
    ),
]


def known_preset(name: str | None) -> str | None:
    """The name of a preset as it is, or a usage error that lists the presets."""
    return name if name is None else one_of("--preset", name, completion.PRESETS, "preset")


def _known_device(name: str) -> str:
    """The name of a kind of device as it is, or a usage error."""
    return one_of("--device", name, completion.DEVICES, "device")


Preset = Annotated[
    str,
    typer.Option(
        help="How much time to spend: tiny | draft | balanced | paper.",
        autocompletion=completion.presets,
        callback=known_preset,
        rich_help_panel=GENERAL,
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.", rich_help_panel=GENERAL)]
Device = Annotated[
    str,
    typer.Option(
        help="auto | cpu | cuda.",
        autocompletion=completion.devices,
        callback=_known_device,
        rich_help_panel=GENERAL,
    ),
]
Recompute = Annotated[
    bool,
    typer.Option(
        "--recompute",
        help="Compute the networks' activations again in the backward pass instead of keeping them: the same "
        "result in less memory, for about a third more time in the networks.",
    ),
]
Force = Annotated[
    bool,
    typer.Option("--force", help="Run the stage even if its result is up to date.", rich_help_panel=GENERAL),
]
FilmFolder = Annotated[Path, typer.Option("-o", "--output", help="Folder of film and frames.")]
Betas = Annotated[str, typer.Option(help="Another body shape: up to ten numbers, 0.5,-1.2.")]
FrameRate = Annotated[float, typer.Option(min=0, help="Frames per second; 0 keeps the motion's own.")]
Pixels = Annotated[int | None, typer.Option(min=16, max=8192, help="Pixels.")]
Distilled = Annotated[
    bool, typer.Option("--distilled", help="Use the blendshapes of `gw distill`, which play in real time.")
]
Swap = Annotated[
    bool, typer.Option(help="Beneath a garment, give the body the form of the garment's source.")
]


def preset_config(presets: dict[str, Config], name: str) -> Config:
    """The preset called `name`, or a usage error that lists the known ones."""
    return presets[one_of("--preset", name, tuple(presets), "preset")]


def one_of(option: str, name: str, known: tuple[str, ...], kind: str = "choice") -> str:
    """The name, or a usage error that lists the known ones."""
    if name not in known:
        raise UsageProblem(
            f"There is no {kind} called {name!r}.",
            f"option {option}",
            "Choose one of: " + ", ".join(known) + ".",
        )
    return name


def names(text: str) -> tuple[str, ...]:
    """The names in a comma-separated list."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def parse_ranks(text: str) -> tuple[int, int, int]:
    """Numbers of bases for offsets, colours and form: "16,6,4"."""
    parts = names(text)
    if len(parts) != 3 or not all(part.isdecimal() and 1 <= int(part) <= 256 for part in parts):
        raise UsageProblem(
            f"{text!r} is not three numbers of bases.",
            "option --ranks",
            "Give three from 1 to 256, as 16,6,4.",
        )
    offset, color, form = (int(part) for part in parts)
    return offset, color, form


def without_shard(words: Sequence[str]) -> str:
    """The command line that puts the parts together: `sys.argv` as it is, but for --shard."""
    shortened, skip = ["gw"], False
    for word in words[1:]:
        if skip or word.startswith("--shard="):
            skip = False
        elif word == "--shard":
            skip = True
        else:
            shortened.append(word)
    return shlex.join(shortened)

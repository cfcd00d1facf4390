"""Inputs that a command line names, checked before anything heavy is loaded.

The stages check them again, and more closely. These checks let a mistyped path be answered without torch.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from stages.shared.errors import MissingInput
from stages.shared.input_files import CANONICAL


def check_stages(subject: Path, *names: str) -> None:
    """Raise what a stage raises when the artifacts of the stages `names` are missing or damaged.

    The error names the first stage that is missing, which may come before those of `names`.
    """
    from stages.pipeline import BY_NAME, OPTIONAL, PIPELINE
    from stages.shared.artifacts.workspace import Workspace

    workspace = Workspace(subject)
    for name in names:
        try:
            workspace.require(BY_NAME[name])
        except MissingInput:
            needed = _with_upstream(name)
            for spec in PIPELINE + OPTIONAL:
                if spec.name in needed:
                    workspace.require(spec)
            raise


def _with_upstream(name: str) -> set[str]:
    """A stage and all that it reads from, directly or not."""
    from stages.pipeline import BY_NAME

    return {name}.union(*(_with_upstream(before) for before in BY_NAME[name].reads))


def check_inputs_of(stage: str, subject: Path) -> None:
    """Raise when a stage that `stage` reads from has not been run for this subject."""
    from stages.pipeline import BY_NAME

    check_stages(subject, *BY_NAME[stage].reads)


def export_command(subject: Path) -> tuple[str | Path, ...]:
    """What to type to export the outermost layer of a subject."""
    from gw_cli.completion import layers_of

    layer = (layers_of(subject) or ["body"])[-1]
    return ("gw", "export-garment", subject, "--layer", layer, "-o", f"{layer}.gwg")


def check_bundles(paths: Iterable[Path]) -> None:
    """Raise when a bundle is missing or its header cannot be read."""
    from stages.shared.artifacts.bundle import read_card

    for path in paths:
        read_card(path)


def check_sources(sources: list[Path]) -> None:
    """Raise when bundles are missing, or the one folder among them is not a trained subject."""
    if len(sources) == 1 and sources[0].is_dir():
        check_stages(sources[0], "train")
    else:
        check_bundles(path for path in sources if not path.is_dir())


def check_poses(paths: Iterable[Path | None]) -> None:
    """Raise when a pose file is missing. None and `canonical` (one frame, canonical pose) are not files."""
    for path in paths:
        if path is not None and str(path) != CANONICAL and not path.exists():
            raise MissingInput("There is no pose file.", str(path), "Check the path.")


def check_exists(path: Path | None, what: str = "capture") -> None:
    """Raise when a path does not exist; `what` names it in the message. None is no path."""
    if path is not None and not path.exists():
        raise MissingInput(f"There is no such {what}.", str(path), "Check the path.")

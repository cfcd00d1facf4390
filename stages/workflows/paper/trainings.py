"""Which trainings a subject has: artifacts of `gw train` made from the maps in use."""

from __future__ import annotations

from typing import Any

from stages.pipeline import BAKE_MAPS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.artifacts.canonical import plain
from stages.shared.errors import MissingInput


def trainings(workspace: Workspace) -> list[Artifact]:
    """Trainings of the maps in use, the shortest list of parts left out first.

    Raises:
        MissingInput: there is none.
    """
    found = _of_these_maps(workspace)
    if not found:
        raise MissingInput(
            "This subject has no training.", str(workspace.root), f"Run: {workspace.command(TRAIN)}"
        )
    return sorted(found, key=lambda artifact: (len(without_of(artifact)), method_of(artifact), artifact.key))


def method_of(artifact: Artifact) -> str:
    """The method of a training."""
    return str(artifact.summary.get("method", "gaussian-wardrobe"))


def without_of(artifact: Artifact) -> tuple[str, ...]:
    """The parts that a training left out."""
    return tuple(artifact.summary.get("without", ()))


def training_like(workspace: Workspace, config: Any) -> Artifact | None:
    """The training of the maps in use that a configuration gave, also with an earlier version of the code.

    Method, parts left out, minutes, steps and seed must be the same; of several, the one with most settings
    in common is it. None without a configuration, or where there is none.
    """
    asked = {} if config is None else plain(config)
    telling = ("method", "without", "minutes", "steps", "seed")

    def alike(artifact: Artifact) -> int:
        had = artifact.manifest.config
        return sum(had.get(name) == value for name, value in asked.items())

    found = [
        artifact
        for artifact in _of_these_maps(workspace)
        if asked and all(artifact.manifest.config.get(name) == asked[name] for name in telling)
    ]
    return max(found, key=alike, default=None)


def _of_these_maps(workspace: Workspace) -> list[Artifact]:
    maps = workspace.require(BAKE_MAPS).key
    found = [Artifact(path) for path in workspace.artifacts() if path.parent.name == TRAIN.name]
    return [artifact for artifact in found if artifact.manifest.inputs["bake-maps"].key == maps]

"""Which trainings a subject has: artifacts of `gw train` made from the maps in use."""

from __future__ import annotations

from stages.pipeline import BAKE_MAPS, TRAIN
from stages.shared.artifacts import Artifact, Workspace
from stages.shared.errors import MissingInput


def trainings(workspace: Workspace) -> list[Artifact]:
    """Trainings of the maps in use, the shortest list of parts left out first.

    Raises:
        MissingInput: there is none.
    """
    maps = workspace.require(BAKE_MAPS).key
    found = [Artifact(path) for path in workspace.artifacts() if path.parent.name == TRAIN.name]
    found = [artifact for artifact in found if artifact.manifest.inputs["bake-maps"].key == maps]
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

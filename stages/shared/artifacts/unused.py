"""Finished artifacts that nothing uses any more, and their removal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.canonical import unseal
from stages.shared.artifacts.files import remove_folder, rename
from stages.shared.artifacts.leftovers import temporary_path
from stages.shared.artifacts.workspace import CURRENT_NAME, Workspace
from stages.shared.errors import MissingInput


@dataclass(frozen=True)
class Unused:
    """One artifact that is not in use: its folder, and the bytes that it takes."""

    path: Path
    bytes: int


def unused(workspace: Workspace) -> list[Unused]:
    """Artifacts that are not in use, and that no artifact in use was made from.

    Raises:
        MissingInput: the folder is no workspace.
        BadData: a pointer or a manifest in use is damaged, so that what it needs cannot be known.
    """
    if not workspace.root.is_dir():
        raise MissingInput("There is no such subject.", str(workspace.root), "Give the folder of a subject.")
    needed = _in_use(workspace)
    waiting = sorted(needed)
    while waiting:
        folder = workspace.root / waiting.pop()
        if not folder.is_dir():
            continue
        for entry in Artifact(folder).manifest.inputs.values():
            name = f"{entry.stage}/{entry.key}"
            if entry.stage is not None and name not in needed:
                needed.add(name)
                waiting.append(name)
    return [
        Unused(folder, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))
        for folder in workspace.artifacts()
        if f"{folder.parent.name}/{folder.name}" not in needed
    ]


def remove_unused(workspace: Workspace) -> list[Unused]:
    """Remove them, and say which they were. A kill leaves every artifact whole or gone.

    Raises:
        Locked: another process writes to this workspace. Otherwise as `unused`.
    """
    unused(workspace)  # refuses a folder that is no workspace before a lock is made in it
    with workspace.writing():
        artifacts = unused(workspace)
        for artifact in artifacts:
            # Renamed first: what has an artifact's name is always whole.
            hidden = temporary_path(workspace.root, artifact.path.parent.name)
            rename(artifact.path, hidden)
            remove_folder(hidden)
    return artifacts


def _in_use(workspace: Workspace) -> set[str]:
    """The `stage/key` of every artifact that a `current.json` points at."""
    pointers = sorted(workspace.root.glob(f"*/{CURRENT_NAME}"))
    return {
        f"{pointer.parent.name}/{unseal(pointer.read_bytes(), pointer).get('key')}" for pointer in pointers
    }

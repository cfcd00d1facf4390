"""Every byte of a workspace against the digests recorded when it was written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.shared.artifacts.artifact import Artifact
from stages.shared.artifacts.canonical import unseal
from stages.shared.artifacts.external import file_digest
from stages.shared.artifacts.manifest import MANIFEST_NAME, RUN_NAME
from stages.shared.artifacts.workspace import CURRENT_NAME, Workspace
from stages.shared.errors import BadData, GwError, MissingInput


@dataclass(frozen=True)
class Damage:
    """One file that is not what was written."""

    path: Path
    what: str


@dataclass(frozen=True)
class Verification:
    """How much was read, and what was found to be damaged."""

    artifacts: int
    files: int
    bytes: int
    damaged: list[Damage]


def verify(workspace: Workspace) -> Verification:
    """Read all files of all finished artifacts; the workspace is not changed.

    Raises:
        MissingInput: the folder is not there, or is no workspace.
    """
    if not workspace.root.is_dir():
        is_file = workspace.root.is_file()
        raise MissingInput(
            "This file is of no kind that can be verified." if is_file else "There is no such folder.",
            str(workspace.root),
            "Give the folder of a subject, or a file .gwg, .ply, .spz or .glb.",
        )
    folders = workspace.artifacts()
    if not folders and not (workspace.root / "subject.json").exists():
        raise MissingInput(
            "This folder is not a subject: it holds no artifact.",
            str(workspace.root),
            "Give the folder of a subject.",
        )
    damaged = _settings_damage(workspace)
    files = size = 0
    for folder in folders:
        found, read, read_bytes = _check(folder)
        damaged += found
        files += read
        size += read_bytes
    for pointer in sorted(workspace.root.glob(f"*/{CURRENT_NAME}")):
        damaged += _pointer_damage(pointer)
    return Verification(len(folders), files, size, damaged)


def _check(folder: Path) -> tuple[list[Damage], int, int]:
    """Damage of one artifact, and the files and bytes read."""
    try:
        artifact = Artifact(folder)
    except BadData as error:
        return [Damage(Path(error.where), error.what)], 0, 0
    damaged = []
    entries = dict(artifact.manifest.files)
    try:
        entries |= artifact.records
    except BadData as error:
        damaged.append(Damage(folder / RUN_NAME, error.what))
    for name, entry in entries.items():
        try:
            if file_digest(folder / name) != entry.sha256:
                damaged.append(Damage(folder / name, "its content is not what was written"))
        except GwError as error:
            damaged.append(Damage(folder / name, error.what))
    expected = {MANIFEST_NAME, RUN_NAME, *entries}
    for path in sorted(folder.rglob("*")):
        if not path.is_dir() and path.relative_to(folder).as_posix() not in expected:
            damaged.append(Damage(path, "nothing wrote this file"))
    return damaged, len(entries) + 2, sum(entry.bytes for entry in entries.values())


def _pointer_damage(pointer: Path) -> list[Damage]:
    try:
        key = unseal(pointer.read_bytes(), pointer).get("key")
    except BadData as error:
        return [Damage(pointer, error.what)]
    if not (pointer.parent / str(key)).is_dir():
        return [Damage(pointer, "it points at an artifact that is not there")]
    return []


def _settings_damage(workspace: Workspace) -> list[Damage]:
    try:
        workspace.settings()
    except BadData as error:
        return [Damage(Path(error.where), error.what)]
    return []

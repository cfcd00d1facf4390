"""Hidden folders of a workspace that hold unfinished work, and the removal of stale ones."""

from __future__ import annotations

import contextlib
import secrets
from pathlib import Path

from stages.shared.artifacts import lock
from stages.shared.artifacts.files import remove_folder, rename

_TEMPORARY, _PROGRESS, _BACKUP = ".tmp-", ".progress-", ".tmp-old-"


def temporary_path(root: Path, stage: str) -> Path:
    """A new name for an artifact that is being written, or removed."""
    return root / f".{stage}{_TEMPORARY}{secrets.token_hex(6)}"


def progress_path(root: Path, stage: str, key: str) -> Path:
    """Where the unfinished work of a long stage is kept."""
    return root / f".{stage}{_PROGRESS}{key}"


def backup_path(root: Path, stage: str, key: str) -> Path:
    """Where an artifact stands for the moment in which another takes its place."""
    return root / f".{stage}{_BACKUP}{key}"


def acquire_writer(root: Path) -> None:
    """Become the writer of a workspace, after removing what killed processes left; `lock.release` ends it.

    Raises:
        Locked: another process writes. StorageFailure: the lock file cannot be made.
    """
    lock.acquire(root, lambda: remove_leftovers(root))


def writing(root: Path) -> contextlib.AbstractContextManager[None]:
    """`acquire_writer` for a block."""
    return lock.holding(root, lambda: remove_leftovers(root))


def remove_leftovers(root: Path) -> None:
    """Remove what killed processes left behind. The caller holds the lock, so none of it is in use."""
    for backup in root.glob(f".*{_BACKUP}*"):
        stage, key = backup.name[1:].split(_BACKUP)
        if not (root / stage / key).exists():
            rename(backup, root / stage / key)
    for left in [*root.glob(f".*{_TEMPORARY}*"), *root.glob(f"*/.*{_TEMPORARY}*")]:
        if left.is_dir() and not left.is_symlink():
            remove_folder(left)
        else:
            left.unlink(missing_ok=True)
    for progress in root.glob(f".*{_PROGRESS}*"):
        stage, key = progress.name[1:].split(_PROGRESS)
        if (root / stage / key / "manifest.json").exists():
            remove_folder(progress)

"""Temporary files and folders: a process locks each while it fills it, so stale ones can be removed.

The operating system releases the lock when a process ends, however it ends. A temporary without a lock is
therefore stale, and the next run that writes to the same folder removes it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

_NAME = re.compile(r"\.(?P<target>.+)\.tmp-[0-9a-f]{12}(?P<old>-old)?")
_swept: set[Path] = set()  # folders whose left-over files this process has removed


def temporary_path(target: Path) -> Path:
    """A hidden name in the folder of `target` that no other process uses."""
    return target.parent / f".{target.name}.tmp-{secrets.token_hex(6)}"


def claim(descriptor: int, path: Path) -> bool:
    """Lock an open temporary until its descriptor is closed.

    Returns False where another process took `path` for a left-over and removed it before it was locked.
    """
    with contextlib.suppress(OSError):  # a file system without locks: nothing is ever swept there
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        return path.stat().st_ino == os.fstat(descriptor).st_ino
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def claimed_folder(target: Path) -> Iterator[Path]:
    """A new temporary folder for `target`, locked inside the block; the caller renames or removes it."""
    while True:
        path = temporary_path(target)
        path.mkdir(mode=0o755)
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # swept before it could be locked
        try:
            if claim(descriptor, path):
                yield path
                return
        finally:
            os.close(descriptor)


def sweep_once(folder: Path) -> None:
    """`sweep_files` at the first call for a folder; later calls of this process cost nothing."""
    folder = folder.absolute()
    if folder not in _swept:
        _swept.add(folder)
        sweep_files(folder)


def sweep_files(folder: Path) -> None:
    """Remove temporary files that killed processes left in a folder; one that is not there is fine."""
    for path in sorted(folder.glob(".*.tmp-*")):
        if path.is_file() and not path.is_symlink() and _NAME.fullmatch(path.name):
            with contextlib.suppress(OSError), _unclaimed(path) as is_left:
                if is_left:
                    path.unlink()


def sweep_folders(target: Path) -> None:
    """Remove temporary folders of `target` that killed processes left, and bring back what they put aside."""
    for path in sorted(target.parent.glob(f".{_escaped(target.name)}.tmp-*")):
        match = _NAME.fullmatch(path.name)
        if not match or match["target"] != target.name or path.is_symlink() or not path.is_dir():
            continue
        with contextlib.suppress(OSError), _unclaimed(path) as is_left:
            if is_left and match["old"] and not target.exists():
                path.rename(target)  # the kill came between the two renames of a replacement
            elif is_left:
                shutil.rmtree(path)


@contextlib.contextmanager
def _unclaimed(path: Path) -> Iterator[bool]:
    """Whether no process holds a temporary; it stays locked inside the block."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except BlockingIOError:
        yield False
    finally:
        os.close(descriptor)


def _escaped(name: str) -> str:
    return re.sub(r"([*?\[])", r"[\1]", name)

"""One writer per workspace: `flock` on a file that says who holds it. Readers never lock."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from stages.shared.artifacts.files import make_folders, storage_failure
from stages.shared.errors import Locked

LOCK_NAME = ".lock"
_WAIT_SECONDS = 0.5  # for a winner that has the lock but has not written its name yet


@dataclass
class _Held:
    descriptor: int
    process: int
    thread: int
    count: int


_held: dict[Path, _Held] = {}
_guard = threading.Lock()


def acquire(workspace: Path, on_first: Callable[[], None] = lambda: None) -> None:
    """Become the writer of a workspace, or count one more use if this thread is it already.

    The operating system lets go of the lock when its process ends, however it ends, so a dead owner is no
    hindrance.

    Arguments:
        on_first: called once the lock is newly held, e.g. to clear what a killed process left behind.

    Raises:
        Locked: another process (or thread) writes; raised within a second, with its process id and host.
        StorageFailure: the lock file cannot be made.
    """
    make_folders(workspace)
    name = workspace.resolve()
    with _guard:
        held = _held.get(name)
        if held is not None and held.process == os.getpid():
            if held.thread != threading.get_ident():
                raise _locked(workspace, {"process": os.getpid(), "host": socket.gethostname()})
            held.count += 1
            return
        _held[name] = _Held(_take(workspace), os.getpid(), threading.get_ident(), 1)
    try:
        on_first()
    except BaseException:
        release(workspace)
        raise


def release(workspace: Path) -> None:
    """End one use; the last one lets other processes write."""
    name = workspace.resolve()
    with _guard:
        held = _held.get(name)
        if held is None or held.process != os.getpid():
            return
        held.count -= 1
        if held.count == 0:
            del _held[name]
            os.close(held.descriptor)


@contextlib.contextmanager
def holding(workspace: Path, on_first: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Be the writer inside the block; see `acquire`."""
    acquire(workspace, on_first)
    try:
        yield
    finally:
        release(workspace)


def _take(workspace: Path) -> int:
    path = workspace / LOCK_NAME
    deadline = time.monotonic() + _WAIT_SECONDS
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                owner = _owner(path)
                if _is_running(owner) or time.monotonic() > deadline:
                    os.close(descriptor)
                    raise _locked(workspace, owner) from None
                time.sleep(0.01)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, json.dumps(_myself()).encode(), 0)
    except OSError as error:
        raise storage_failure(error, path, None) from error
    return descriptor


def _myself() -> dict[str, str | int]:
    started = datetime.now(UTC).isoformat(timespec="seconds")
    return {"process": os.getpid(), "host": socket.gethostname(), "started": started}


def _owner(path: Path) -> dict[str, str | int]:
    try:
        owner = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}  # the winner is about to write its name
    return owner if isinstance(owner, dict) else {}


def _is_running(owner: dict[str, str | int]) -> bool:
    """Whether the name in the file can be that of the holder, not of an earlier one that died."""
    process = owner.get("process")
    if owner.get("host") != socket.gethostname() or not isinstance(process, int):
        return bool(owner)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _locked(workspace: Path, owner: dict[str, str | int]) -> Locked:
    process, host = owner.get("process", "unknown"), owner.get("host", "unknown")
    since = f" since {owner['started']}" if "started" in owner else ""
    return Locked(
        f"Process {process} on host {host} is writing to this folder{since}.",
        str(workspace / LOCK_NAME),
        "Wait until it is done, or stop that process, then run the same command again.",
    )

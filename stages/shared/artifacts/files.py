"""The file layer: all writes of the store go through these few calls.

`FileLayer` can be replaced by tests: theirs fails, or kills the process, at the n-th call.
Failures become `StorageFailure` with the bytes that were needed and the bytes that are free.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from stages.shared.artifacts.temporary import (
    claim,
    claimed_folder,
    sweep_folders,
    sweep_once,
    temporary_path,
)
from stages.shared.errors import StorageFailure

WRITE_BYTES = 4 << 20
Chunks = bytes | bytearray | memoryview | Iterable[bytes | bytearray | memoryview]


class FileLayer:
    """The operating system's calls that change the disk, one method each."""

    def create(self, path: Path) -> int:
        """Descriptor of a new file; it must not exist yet."""
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)

    def append(self, path: Path) -> int:
        """Descriptor at the end of a file that may exist."""
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)

    def write(self, descriptor: int, data: memoryview) -> int:
        """Bytes taken, possibly fewer than given."""
        return os.write(descriptor, data)

    def flush(self, descriptor: int) -> None:
        """Bring a file to the disk."""
        os.fsync(descriptor)

    def flush_folder(self, path: Path) -> None:
        """Bring a folder's list of names to the disk."""
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        """Atomic on one file system: the target is the old one or the new one, never half."""
        source.rename(target)

    def make_folder(self, path: Path) -> None:
        """A new folder; its parent exists."""
        path.mkdir(mode=0o755)


_layer = FileLayer()


@contextlib.contextmanager
def using_layer(layer: FileLayer) -> Iterator[FileLayer]:
    """Write through `layer` inside the block (fault injection)."""
    global _layer
    previous, _layer = _layer, layer
    try:
        yield layer
    finally:
        _layer = previous


@contextlib.contextmanager
def _storing(path: Path, needed_bytes: int | None = None) -> Iterator[None]:
    """Turn the operating system's refusals into `StorageFailure`."""
    try:
        yield
    except OSError as error:
        raise storage_failure(error, path, needed_bytes) from error


def storage_failure(error: OSError, path: Path, needed_bytes: int | None) -> StorageFailure:
    """What to tell a user when `path` could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        needed = "" if needed_bytes is None else f"{needed_bytes} bytes needed, "
        return StorageFailure(
            f"The disk is full: {needed}{free_bytes(path)} bytes free.",
            str(path),
            "Free some space and run the same command again; nothing half-written is left.",
        )
    return StorageFailure(
        f"Writing failed: {error.strerror or error}.",
        str(path),
        "Check the disk and the permissions of the folder, then run the same command again.",
    )


def free_bytes(path: Path) -> int:
    """Free space of the file system that holds, or would hold, `path`."""
    for folder in (path, *path.absolute().parents):
        if folder.exists():
            return shutil.disk_usage(folder).free
    return 0


def require_room(folder: Path, needed_bytes: int) -> None:
    """Refuse before starting when less than 1.2 times the estimate is free.

    Raises:
        StorageFailure: with the bytes needed and free.
    """
    free = free_bytes(folder)
    if free < 1.2 * needed_bytes:
        raise StorageFailure(
            f"The disk is too full to start: about {needed_bytes} bytes needed, {free} bytes free.",
            str(folder),
            "Free some space, or put the subject on another disk.",
        )


def write_file(path: Path, data: Chunks) -> None:
    """Write and flush a file that does not exist yet. Not atomic: for files inside a temporary folder."""
    chunks = [memoryview(chunk).cast("B") for chunk in _as_chunks(data)]
    with _storing(path, sum(len(chunk) for chunk in chunks)):
        descriptor = _layer.create(path)
    try:
        _fill(path, descriptor, chunks)
    finally:
        os.close(descriptor)


def _fill(path: Path, descriptor: int, chunks: list[memoryview]) -> None:
    """Write and flush the chunks; `path` is named where that fails."""
    with _storing(path, sum(len(chunk) for chunk in chunks)):
        for chunk in chunks:
            _write_all(descriptor, chunk)
        _layer.flush(descriptor)


def _as_chunks(data: Chunks) -> Iterable[bytes | bytearray | memoryview]:
    return (data,) if isinstance(data, bytes | bytearray | memoryview) else data


def _write_all(descriptor: int, data: memoryview) -> None:
    position = 0
    while position < len(data):
        position += _layer.write(descriptor, data[position : position + WRITE_BYTES])


def write_whole(path: Path, data: Chunks) -> None:
    """Write a file whole or not at all: temporary file in the same folder, flush, rename, flush the folder.

    Folders that are missing are made. What stood at `path` before is replaced, or untouched on failure.
    Temporary files that killed processes left in the folder are removed.

    Raises:
        StorageFailure: disk full, no permission, medium error.
    """
    path = Path(path)
    make_folders(path.parent)
    with _storing(path):
        sweep_once(path.parent)
    chunks = [memoryview(chunk).cast("B") for chunk in _as_chunks(data)]
    with _storing(path, sum(len(chunk) for chunk in chunks)):
        temporary, descriptor = _create_temporary(path)
    try:
        _fill(temporary, descriptor, chunks)
        rename(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(descriptor)  # the lock on the temporary is held until it has its name


def _create_temporary(path: Path) -> tuple[Path, int]:
    """A new temporary file for `path`, locked, and its descriptor."""
    while True:
        temporary = temporary_path(path)
        descriptor = _layer.create(temporary)
        if claim(descriptor, temporary):
            return temporary, descriptor
        os.close(descriptor)


def append_whole(path: Path, line: bytes) -> None:
    """Add to the end of a file in a single write, without waiting for the disk."""
    with _storing(path, len(line)):
        descriptor = _layer.append(path)
        try:
            _write_all(descriptor, memoryview(line))
        finally:
            os.close(descriptor)


def flush_file(path: Path) -> None:
    """Bring a file that another library wrote to the disk."""
    with _storing(path):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            _layer.flush(descriptor)
        finally:
            os.close(descriptor)


def rename(source: Path, target: Path) -> None:
    """Rename, then flush both folders so that the new name survives a power cut."""
    with _storing(target):
        _layer.rename(source, target)
        _layer.flush_folder(target.parent)
        if source.parent != target.parent:
            _layer.flush_folder(source.parent)


def flush_folder(path: Path) -> None:
    """Bring a folder's list of names to the disk."""
    with _storing(path):
        _layer.flush_folder(path)


def make_folders(path: Path) -> None:
    """Make a folder and the parents that are missing, each flushed into its parent."""
    if path.is_dir():
        return
    make_folders(path.parent)
    with _storing(path):
        try:
            _layer.make_folder(path)
        except FileExistsError:
            if not path.is_dir():
                raise
        _layer.flush_folder(path.parent)


def make_read_only(folder: Path) -> None:
    """Take the write permission from every file of a finished folder.

    Folders keep theirs, or a user could not remove a subject with plain `rm -r`; the digests tell when a
    file was added or taken away.
    """
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            with _storing(path):
                path.chmod(0o444)


def remove_folder(folder: Path) -> None:
    """Remove a folder with all it holds; one that is not there is fine."""
    with _storing(folder):
        if folder.exists():
            shutil.rmtree(folder)


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder outside the workspace, whole or absent: fill the yielded one; it gets its name at the end.

    A folder already at `path` is replaced on success and untouched on failure.

    Raises:
        StorageFailure: disk full, no permission, medium error.
    """
    path = Path(path)
    make_folders(path.parent)
    with contextlib.ExitStack() as stack:
        with _storing(path):
            sweep_folders(path)
            temporary = stack.enter_context(claimed_folder(path))
        try:
            yield temporary
            for file in sorted(temporary.rglob("*")):
                if file.is_file():
                    flush_file(file)
            replace_folder(temporary, path, aside=temporary.with_name(temporary.name + "-old"))
        except BaseException:
            remove_folder(temporary)
            raise


def replace_folder(source: Path, target: Path, aside: Path) -> None:
    """Give the finished folder `source` the name `target`, putting away what stood there.

    A folder that is not empty cannot be replaced by a rename, so the old one first steps to `aside`; it comes
    back if the second rename fails.
    """
    if not target.exists():
        rename(source, target)
        return
    rename(target, aside)
    try:
        rename(source, target)
    except BaseException:
        if not target.exists():
            aside.rename(target)
        raise
    remove_folder(aside)

"""Files outside the workspace that a stage reads: their digests, and whether they have changed."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.shared.artifacts.canonical import canonical_json, digest
from stages.shared.artifacts.files import write_whole
from stages.shared.errors import MissingInput, StorageFailure

READ_BYTES = 1 << 20
# A file that changed this recently could change again with the same time stamp, so its digest is not cached.
_SETTLED_NANOSECONDS = 2_000_000_000
CACHE_NAME = ".digests.json"


@dataclass(frozen=True)
class ExternalFiles:
    """A named group of input files, e.g. the label images of a capture.

    Attributes:
        name: such as "capture/labels". The part before the slash names the setting in `subject.json` that
            says where `root` is, so that a moved capture is found again.
        root: folder the files are listed against.
        files: paths below `root`.
    """

    name: str
    root: Path
    files: Sequence[Path]

    @property
    def setting(self) -> str:
        return self.name.split("/")[0]

    def listed(self) -> list[str]:
        """Paths of the files relative to `root`, with forward slashes."""
        return [os.path.relpath(file, self.root).replace(os.sep, "/") for file in self.files]

    def listing(self, cache: DigestCache) -> dict[str, str]:
        """SHA-256 of every file by its path relative to `root`, sorted.

        Raises:
            MissingInput: a file is not there.
            StorageFailure: a file cannot be read.
        """
        relative = dict(zip(self.listed(), map(Path, self.files), strict=True))
        outside = [path for path in relative if path.startswith("../")]
        if outside:
            raise ValueError(f"{self.name}: {outside[0]} is not below {self.root}")
        return {path: cache.digest(relative[path]) for path in sorted(relative)}


def listing_digest(listing: dict[str, str]) -> str:
    """One digest for a group of files: of their relative paths and their contents."""
    return digest(canonical_json(listing))


def changes(recorded: dict[str, str], root: Path, cache: DigestCache) -> Iterable[str]:
    """Relative paths of a recorded listing whose files are gone or changed, each with what happened."""
    for path, expected in recorded.items():
        try:
            found = cache.digest(root / path)
        except MissingInput:
            yield f"{path} is gone"
            continue
        if found != expected:
            yield f"{path} changed"


def complete_folders(listing: Iterable[str], root: Path) -> list[str]:
    """Folders of which a listing holds everything of its kind: a new file there is a new input.

    A folder counts where the listing has two files or more with the same ending and leaves none out; a name
    that ends in a slash is a folder of two or more such folders, where a new folder would be a new input.
    """
    kinds = _kinds(listing)
    whole = [
        folder
        for folder, (suffixes, names) in kinds.items()
        if len(names) > 1 and not _others(root / folder, suffixes, names)
    ]
    above: dict[str, set[str]] = {}
    for folder in whole:
        parent, _, name = folder.rpartition("/")
        above.setdefault(parent, set()).add(name)
    whole += [
        f"{parent}/" for parent, names in above.items() if len(names) > 1 and _folders(root / parent) == names
    ]
    return sorted(whole)


def newcomers(listing: Iterable[str], root: Path, complete: Iterable[str]) -> list[str]:
    """Files and folders that have come to `complete_folders` since."""
    kinds = _kinds(listing)
    found = []
    for folder in complete:
        if folder.endswith("/"):
            known = {name.rpartition("/")[2] for name in kinds if name.rpartition("/")[0] == folder[:-1]}
            new = sorted(_folders(root / folder.strip("/")) - known)
            found += [f"{folder}{name}".removeprefix("/") for name in new]
        elif folder in kinds:
            others = _others(root / folder, *kinds[folder])
            found += [f"{folder}/{name}" if folder else name for name in sorted(others)]
    return found


def _kinds(listing: Iterable[str]) -> dict[str, tuple[set[str], set[str]]]:
    """Endings and names of the listed files, by folder."""
    kinds: dict[str, tuple[set[str], set[str]]] = {}
    for path in listing:
        folder, _, name = path.rpartition("/")
        suffixes, names = kinds.setdefault(folder, (set(), set()))
        suffixes.add(Path(name).suffix)
        names.add(name)
    return kinds


def _others(folder: Path, suffixes: set[str], names: set[str]) -> set[str]:
    """Files of a folder with one of the endings that are not among the names."""
    try:
        there = {entry.name for entry in os.scandir(folder) if entry.is_file()}
    except OSError:
        return set()
    return {name for name in there - names if Path(name).suffix in suffixes and not name.startswith(".")}


def _folders(folder: Path) -> set[str]:
    try:
        return {e.name for e in os.scandir(folder) if e.is_dir() and not e.name.startswith(".")}
    except OSError:
        return set()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes as hex.

    Raises:
        MissingInput, StorageFailure: the file is not there, or cannot be read.
    """
    hasher = hashlib.sha256()
    try:
        with path.open("rb", buffering=0) as file:
            while chunk := file.read(READ_BYTES):
                hasher.update(chunk)
    except OSError as error:
        raise unreadable(path, error) from error
    return hasher.hexdigest()


def unreadable(path: Path, error: OSError) -> MissingInput | StorageFailure:
    """The error for an input file that could not be read."""
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return MissingInput("An input file is not there.", str(path), "Put it back, or give another input.")
    if isinstance(error, IsADirectoryError):
        return MissingInput("An input file is a folder.", str(path), "Put the file back, or give another.")
    return StorageFailure(f"Reading failed: {error.strerror or error}.", str(path), "Check its permissions.")


class DigestCache:
    """Digests of files that have not changed since they were read, so that `gw status` is quick.

    A file is taken for unchanged while its size, its times of change, and its inode stay the same. The cache
    is only a shortcut: without it everything is read again.
    """

    def __init__(self, workspace: Path) -> None:
        self._folder = workspace
        self._path = workspace / CACHE_NAME
        self._known = self._load()
        self._changed = False

    def digest(self, path: Path) -> str:
        """SHA-256 of a file, read only if it may have changed."""
        name = os.path.relpath(path, self._folder)
        before = _signature(path)
        known = self._known.get(name)
        if known is not None and known[:-1] == list(before):
            return str(known[-1])
        found = file_digest(path)
        settled = time.time_ns() - max(before[1], before[2]) > _SETTLED_NANOSECONDS
        if settled and _signature(path) == before:
            self._known[name] = [*before, found]
            self._changed = True
        return found

    def save(self) -> None:
        """Write the digests of newly read files, if there are any.

        Raises:
            StorageFailure: the workspace cannot be written.
        """
        if self._changed and self._folder.is_dir():
            write_whole(self._path, json.dumps(self._known).encode())
            self._changed = False

    def _load(self) -> dict[str, list[int | str]]:
        try:
            known = json.loads(self._path.read_bytes())
        except (OSError, ValueError):
            return {}  # no cache, or not a usable one: read every file again
        usable = isinstance(known, dict) and all(isinstance(v, list) and len(v) == 5 for v in known.values())
        return known if usable else {}


def _signature(path: Path) -> tuple[int, int, int, int]:
    try:
        found = path.stat()
    except OSError as error:
        raise unreadable(path, error) from error
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino

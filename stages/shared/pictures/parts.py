"""Output folders that are filled over several runs: by shards, or again after a kill.

Until it is complete, the folder OUT is called `.OUT.part-KEY`; then it is renamed to OUT. KEY is a digest of
everything that determines the content, so that a run never continues with the files of another one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from stages.shared.artifacts.files import flush_file, make_folders, remove_folder, replace_folder
from stages.shared.artifacts.lock import holding
from stages.shared.errors import UsageProblem

Item = TypeVar("Item")
_LOCKS = "locks"
RECORDS = "records"  # of finished items; removed when the folder gets its final name


@dataclass(frozen=True)
class Share:
    """The i-th of n parts of the work; 1 of 1 is all of it."""

    index: int = 1
    count: int = 1

    @property
    def whole(self) -> bool:
        """Whether this is all of the work."""
        return self.count == 1

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Every n-th item, so that all shares cost about the same."""
        return list(items[self.index - 1 :: self.count])


def parse_share(text: str) -> Share:
    """ "2/4" is the second of four parts; "" is everything. Raises UsageProblem."""
    if not text:
        return Share()
    index, slash, count = text.partition("/")
    if slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count) <= 10_000:
        return Share(int(index), int(count))
    raise UsageProblem(f"{text!r} is no part of the work.", "option --shard", "Give i/n, as 1/4 to 4/4.")


@contextlib.contextmanager
def part_folder(path: Path, key: str, share: Share) -> Iterator[Path]:
    """The unfinished folder of `path`, created if missing; it stays when the block raises.

    Raises:
        Locked: another process does the same part, or the whole while parts are still at work.
        StorageFailure: no permission, disk full.
    """
    folder = path.parent / f".{path.name}.part-{key}"
    own = folder / _LOCKS / f"{share.index}-of-{share.count}"
    with contextlib.ExitStack() as stack:
        if share.whole:
            stack.enter_context(holding(own))
            for other in sorted((folder / _LOCKS).iterdir()):
                stack.enter_context(holding(other))
        else:
            with holding(folder / _LOCKS / "1-of-1"):
                stack.enter_context(holding(own))
        yield folder


def finish(folder: Path, path: Path, finished: Sequence[Path]) -> None:
    """Give a part folder its name; an older output there is replaced, parts of other runs are removed.

    Arguments:
        finished: files that may not have reached the disk yet.
    """
    for file in finished:
        flush_file(file)
    for name in (RECORDS, _LOCKS):
        remove_folder(folder / name)
    make_folders(path.parent)
    replace_folder(folder, path, aside=folder.with_name(folder.name + "-old"))
    for other in path.parent.glob(f".{path.name}.part-*"):
        remove_folder(other)

"""Output folders of commands that write pictures: whole or absent, never in the place of something else."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

from stages.shared.artifacts.files import whole_folder
from stages.shared.errors import UsageProblem
from stages.shared.targets import check_folder_target


@contextlib.contextmanager
def output_folder(path: Path, result_name: str, mark: str) -> Iterator[Path]:
    """A folder to fill; it gets the name `path` at the end of the block, or nothing happens.

    An older output of the same kind is replaced: a folder whose `result_name` says `"format": mark`. Anything
    else at that path is refused.

    Raises:
        UsageProblem: `path` is something else than an older output. StorageFailure: disk full, no permission.
    """
    check_output(path, result_name, mark)
    with whole_folder(path) as folder:
        yield folder


def check_output(path: Path, result_name: str, mark: str) -> None:
    """Raise UsageProblem unless `path` is absent, empty, or an older output of the same kind."""
    check_folder_target(path.parent)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        known = json.loads((path / result_name).read_bytes()).get("format") == mark
    except (OSError, ValueError, AttributeError):
        known = False
    if not known:
        raise UsageProblem(
            "The output folder holds something else, which would be lost.",
            str(path),
            "Give a new or an empty folder with -o.",
        )

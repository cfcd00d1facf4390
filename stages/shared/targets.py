"""Where results go: a place that cannot take them is refused before anything is computed."""

from __future__ import annotations

from pathlib import Path

from stages.shared.errors import UsageProblem


def check_file_target(path: Path, example: str) -> None:
    """Raise UsageProblem where a file cannot be written: a folder has its name, or a file that of its folder.

    Arguments:
        example: what the user could type instead, as "-o skirt.gwg".
    """
    if path.is_dir():
        raise UsageProblem("A folder is in the place of the file.", str(path), f"Name a file, as {example}.")
    check_folder_target(path.parent)


def check_folder_target(path: Path) -> None:
    """Raise UsageProblem where a folder cannot be made: a file has its name, or that of one above it."""
    for folder in (path, *path.parents):
        if folder.is_dir():
            return
        if folder.exists():
            raise UsageProblem(
                "A file is in the place of the folder.", str(folder), "Give another folder with -o."
            )

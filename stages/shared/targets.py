"""Checks of output paths before anything is computed."""

from __future__ import annotations

from pathlib import Path

from stages.shared.errors import UsageProblem


def check_file_target(path: Path, example: str) -> None:
    """Raise UsageProblem if a file cannot be written: its path is a folder, or its parent is a file.

    Arguments:
        example: a correct option for the message, such as "-o skirt.gwg".
    """
    if path.is_dir():
        raise UsageProblem("A folder is in the place of the file.", str(path), f"Name a file, as {example}.")
    check_folder_target(path.parent)


def check_folder_target(path: Path) -> None:
    """Raise UsageProblem if a folder cannot be made: its path, or one of its parents, is a file."""
    for folder in (path, *path.parents):
        if folder.is_dir():
            return
        if folder.exists():
            raise UsageProblem(
                "A file is in the place of the folder.", str(folder), "Give another folder with -o."
            )

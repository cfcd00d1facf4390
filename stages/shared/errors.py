"""Errors for users: what is wrong, where, and what to do.

Every class carries the exit code of the command line (BSD `sysexits` where one fits).
"""

from __future__ import annotations


class GwError(Exception):
    """A failure that the user can fix. The command line prints three lines and no traceback.

    Arguments:
        what: what is wrong, in one sentence.
        where: the file, array, index or option it concerns.
        fix: what the user can do now.
    """

    exit_code = 70

    def __init__(self, what: str, where: str, fix: str) -> None:
        super().__init__(f"{what} ({where}). {fix}")
        self.what = what
        self.where = where
        self.fix = fix


class UsageProblem(GwError):
    """An option or argument that makes no sense."""

    exit_code = 2


class BadData(GwError):
    """An input exists, but its content is wrong."""

    exit_code = 65


class MissingInput(GwError):
    """An input does not exist."""

    exit_code = 66


class StorageFailure(GwError):
    """Writing or reading failed: disk full, no permission, or a hardware error."""

    exit_code = 74


class Locked(GwError):
    """Another process writes to this workspace; try again later."""

    exit_code = 75

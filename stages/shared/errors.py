"""Errors that a user can act on: what is wrong, where, and what to do about it.

Every class carries the exit code of the command line (BSD `sysexits` where one fits).
"""

from __future__ import annotations


class GwError(Exception):
    """A failure with a cure. Printed as three lines; never as a traceback.

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
    """An option or argument that cannot be meant."""

    exit_code = 2


class BadData(GwError):
    """An input that is there, but is not what it should be."""

    exit_code = 65


class MissingInput(GwError):
    """An input that is not there."""

    exit_code = 66


class StorageFailure(GwError):
    """Writing or reading failed: disk full, no permission, medium error."""

    exit_code = 74


class Locked(GwError):
    """Another process writes to this workspace; try again later."""

    exit_code = 75

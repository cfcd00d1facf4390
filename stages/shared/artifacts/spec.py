"""What the artifact store knows about a stage, and what a stage returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stages.shared.artifacts.artifact import Artifact


@dataclass(frozen=True)
class StageSpec:
    """One stage of the pipeline, as the store sees it.

    Attributes:
        name: folder of its artifacts inside the workspace.
        command: what a user types to make it, with SUBJECT for the workspace.
        reads: names of the stages whose artifacts it reads.
        schema: "major.minor" of what it writes.
        code_version: raised by hand when the same inputs give other bytes.
    """

    name: str
    command: str
    reads: tuple[str, ...]
    schema: str = "1.0"
    code_version: int = 1


@dataclass(frozen=True)
class StageResult:
    """The finished artifact and a few numbers to judge it by."""

    artifact: Artifact
    summary: dict[str, Any]

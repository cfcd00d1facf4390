"""What a stage gives back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stages.shared.artifacts.artifact import Artifact


@dataclass(frozen=True)
class StageResult:
    """The finished artifact and a few numbers to judge it by."""

    artifact: Artifact
    summary: dict[str, Any]

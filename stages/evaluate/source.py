"""The interface of what can be evaluated."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from stages.evaluate.sharding import Row, WorkItem
from stages.shared.losses.perceptual import Perceptual
from stages.shared.pictures.parts import Share
from stages.shared.plan import Plan
from stages.shared.report import Report


class Source(ABC):
    """Opened inputs of an evaluation."""

    @abstractmethod
    def identity(self) -> tuple[dict[str, Any], list[Path]]:
        """What the scores follow from: names and digests, and the files whose content counts."""

    @abstractmethod
    def items(self, perceptual: Perceptual | None) -> list[WorkItem]:
        """The frames or pictures to score."""

    @abstractmethod
    def summary(self, rows: dict[str, list[Row]], folder: Path, report: Report) -> dict[str, Any]:
        """What evaluation.json says, from the rows of every split. May write more files into the folder."""

    @abstractmethod
    def plan(self, output: Path, share: Share) -> Plan:
        """Inputs, outputs and cost."""

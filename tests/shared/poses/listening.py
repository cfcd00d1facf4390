"""A report that keeps what it is warned of."""

from __future__ import annotations

from stages.shared.report import Silent


class Listening(Silent):
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    @property
    def text(self) -> str:
        return "\n".join(self.warnings)

"""The plan that `--dry-run` shows: what a command would do and cost."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Plan:
    """Inputs, outputs, resolved configuration and estimated cost of one command.

    `seconds`, `memory_bytes` and `disk_bytes` are estimates for two CPU cores, or None where no estimate
    exists. `scene` says what the scene requires and what is left out, for commands that decide it:
    {"requires": {…}, "left_out": {name: reason}}.
    """

    inputs: list[str]
    outputs: list[str]
    config: dict[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    memory_bytes: int | None = None
    disk_bytes: int | None = None
    scene: dict[str, Any] = field(default_factory=dict)

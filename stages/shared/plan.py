"""What a command would do and cost, for `--dry-run`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Plan:
    """Inputs, outputs, resolved configuration and estimated cost of one command.

    `seconds`, `memory_bytes` and `disk_bytes` are estimates for two CPU cores; None where nothing
    honest can be said. `scene` is what the scene requires, and what is left out and why, where a command
    decides that: {"requires": {…}, "left_out": {name: reason}}.
    """

    inputs: list[str]
    outputs: list[str]
    config: dict[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    memory_bytes: int | None = None
    disk_bytes: int | None = None
    scene: dict[str, Any] = field(default_factory=dict)

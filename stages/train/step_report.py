"""What one optimiser step reports: its losses, and the seconds of its parts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class StepReport:
    """Figures of one step.

    Attributes:
        step, frame, cameras: what the step saw. finite: False when the step was skipped.
        terms: unweighted losses, `total` weighted. gradient_norm: before clipping.
        seconds: "data", "network", "splat" (pictures with their losses), "surface", "optimiser".
    """

    step: int
    frame: int
    cameras: tuple[str, ...]
    finite: bool
    terms: dict[str, float]
    gradient_norm: float
    seconds: dict[str, float]


class StepClock:
    """Adds up seconds by name: `with clock("data"): …`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

"""What the demo is asked to do."""

from __future__ import annotations

from dataclasses import dataclass

# Optimiser steps per subject: the same result on a slow machine, in about ten minutes on two fast cores.
STEPS = {"draft": 1000}


@dataclass(frozen=True)
class DemoConfig:
    """Size and seed of the demo.

    Attributes:
        preset: preset every stage runs at.
        seed: seed of the synthetic subjects and of training.
        train_steps: optimiser steps per subject; None: those of `STEPS`, else the preset's own.
        device: auto, cpu or cuda.
    """

    preset: str = "draft"
    seed: int = 0
    train_steps: int | None = None
    device: str = "auto"

    @property
    def steps(self) -> int | None:
        """Optimiser steps per subject; None leaves them to the training preset."""
        return STEPS.get(self.preset) if self.train_steps is None else self.train_steps

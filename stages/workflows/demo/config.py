"""What the demo is asked to do."""

from __future__ import annotations

from dataclasses import dataclass

# Training minutes per subject that keep the whole demo under 20 minutes on two cores.
MINUTES = {"draft": 4.5}


@dataclass(frozen=True)
class DemoConfig:
    """Size and seed of the demo.

    Attributes:
        preset: preset every stage runs at.
        seed: seed of the synthetic subjects and of training.
        train_minutes: training budget per subject; None: that of `MINUTES`, else the preset's own.
        device: auto, cpu or cuda.
    """

    preset: str = "draft"
    seed: int = 0
    train_minutes: float | None = None
    device: str = "auto"

    @property
    def minutes(self) -> float | None:
        """Training minutes per subject; None leaves it to the training preset."""
        return MINUTES.get(self.preset) if self.train_minutes is None else self.train_minutes

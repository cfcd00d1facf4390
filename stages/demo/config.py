"""What the demo is asked to do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DemoConfig:
    """Size and seed of the demo.

    Attributes:
        preset: preset every stage runs at.
        seed: seed of the synthetic subjects and of training.
        train_minutes: training budget per subject; None leaves it to the preset.
        device: auto, cpu or cuda.
    """

    preset: str = "draft"
    seed: int = 0
    train_minutes: float | None = None
    device: str = "auto"

"""Settings of `gw bench precision`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BenchPrecisionConfig:
    """What is rendered.

    Attributes:
        frames: rows of the motion, evenly spread. width, height: pixels.
    """

    frames: int = 6
    width: int = 360
    height: int = 480

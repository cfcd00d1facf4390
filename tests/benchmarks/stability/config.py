"""What `python -m tests.benchmarks.stability` measures."""

from __future__ import annotations

from dataclasses import dataclass

PRECISIONS = ("float64", "float32", "bfloat16")


@dataclass(frozen=True)
class StabilityConfig:
    """families: names of groups of functions, empty for all. seed: of the inputs."""

    families: tuple[str, ...] = ()
    seed: int = 0

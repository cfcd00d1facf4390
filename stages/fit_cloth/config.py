"""Configuration of `gw fit-cloth`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class FitClothConfig:
    """How garments are prepared for simulation. Declared fields have their help in their metadata.

    Attributes:
        frames: at most so many frames of the take are simulated, from its first.
        parts: parts of the take, each left out in turn when drivers are compared.
        detail: simulation steps over those of the materials, while fitting.
    """

    vertices: int = option(1100, "Vertices of each simulation mesh, about.", min=30)
    frames: int = 300
    parts: int = 4
    detail: float = 1.0
    materials: tuple[str, ...] = option(
        ("tight", "stiff", "light_knit", "flared", "full_skirt"), "Materials to try, separated by commas."
    )


PRESETS: dict[str, FitClothConfig] = {
    "tiny": FitClothConfig(vertices=150, frames=12, detail=0.3, materials=("tight", "flared")),
    "draft": FitClothConfig(),
    "balanced": FitClothConfig(frames=600),
    "paper": FitClothConfig(vertices=1400, frames=2000),
}

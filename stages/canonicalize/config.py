"""Configuration of `gw canonicalize`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option

SPREADS = ("wide", "inverse", "undiffused", "nearest")
SHAPE_REMOVALS = ("exact", "paper")


@dataclass(frozen=True)
class CanonicalizeConfig:
    """How the template is brought to the canonical pose and the zero shape.

    Attributes:
        resolution: nodes along each side of the voxel grid of skinning weights and shape directions.
        spread: how body values spread into space: "wide" (keeps loose garments whole), "inverse" (the
            paper's released code), "undiffused" (the same without averaging) or "nearest".
        reach_per_distance: for "wide": growth of the smoothing length per metre of distance from the skin.
        shape_removal: "exact" (joints move with the shape) or "paper" (rotated vertex offsets only).
        tear_growth: an edge that grows by more than this factor from world to canonical is torn.
        tear_length_m: and is longer than this afterwards; shorter ones are noise of the scan.
    """

    resolution: int = 64
    spread: str = option(
        "wide",
        "wide | inverse | undiffused | nearest: how skinning weights reach into space.",
        choices=SPREADS,
    )
    reach_per_distance: float = 10.0
    shape_removal: str = option(
        "exact",
        "exact | paper: whether joints move with the shape that is taken out.",
        choices=SHAPE_REMOVALS,
    )
    tear_growth: float = 5.0
    tear_length_m: float = 0.01


PRESETS: dict[str, CanonicalizeConfig] = {
    "tiny": CanonicalizeConfig(resolution=32),
    "draft": CanonicalizeConfig(),
    "balanced": CanonicalizeConfig(),
    "paper": CanonicalizeConfig(),
}

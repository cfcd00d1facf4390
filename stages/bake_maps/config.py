"""Configuration of `gw bake-maps`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BakeMapsConfig:
    """How surfaces become maps of texels.

    Attributes:
        pitch: metres per texel of the grid that all layers and subjects share.
        extent_m: side of the square grid; everything must fit.
        unseen_limit: share of a layer's surface that its maps may miss before hidden surfaces get sheets of
            their own.
        most_sheets: at most this many of those, from front and from back.
        depth_jump_m: neighbouring texels further apart in depth than this are not linked.
        seam_reach_m: a front and a back texel further apart than this do not meet across the silhouette.
        sigma_per_spacing: initial standard deviation of a Gaussian per distance to the next.
        largest_stretch: grazing texels count as at most this much wider than the pitch.
        project_colors: sample the template frame's images at every texel.
    """

    pitch: float = 0.009
    extent_m: float = 2.0
    unseen_limit: float = 0.01
    most_sheets: int = 4
    depth_jump_m: float = 0.03
    seam_reach_m: float = 0.12
    sigma_per_spacing: float = 0.6
    largest_stretch: float = 5.0
    project_colors: bool = True


PRESETS: dict[str, BakeMapsConfig] = {
    "tiny": BakeMapsConfig(pitch=0.02),
    "draft": BakeMapsConfig(),
    "balanced": BakeMapsConfig(pitch=0.004),
    "paper": BakeMapsConfig(pitch=2.0 / 1024),
}

"""Configuration of `gw bake-maps`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import PICTURE_SCALE, option


@dataclass(frozen=True)
class BakeMapsConfig:
    """How surfaces become maps of texels.

    Attributes:
        pitch: metres per texel of the grid that all layers and subjects share.
        extent_m: side of the square grid, metres; everything must fit.
        unseen_limit: share of a layer's surface that its maps may miss. Above it, hidden surfaces get further
            sheets.
        most_sheets: largest number of such sheets, from front and from back.
        depth_jump_m: neighbouring texels further apart in depth than this are not linked.
        seam_reach_m: a front and a back texel further apart than this do not meet across the silhouette.
        sigma_per_spacing: initial standard deviation of a Gaussian per distance to the next.
        largest_stretch: grazing texels count as at most this much wider than the pitch.
        project_colors: sample the template frame's images at every texel.
        picture_scale: size at which pictures are looked at, 1 is the capture's; 0 for the size at which a
            texel covers two to three pixels.
    """

    pitch: float = option(
        0.009,
        "Millimetres per texel; the preset's if left out.",
        flag="--pitch",
        min=0.5,
        max=200,
        per=1000,
    )
    extent_m: float = option(
        2.0, "Side of the square map, metres; everything must fit.", flag="--extent", min=0.5, max=10
    )
    unseen_limit: float = 0.01
    most_sheets: int = option(
        4,
        "Most sheets a side for hidden surfaces; 0: front and back only.",
        flag="--sheets",
        min=0,
        max=15,
    )
    depth_jump_m: float = 0.03
    seam_reach_m: float = 0.12
    sigma_per_spacing: float = 0.6
    largest_stretch: float = 5.0
    project_colors: bool = True
    picture_scale: float = option(0.0, **PICTURE_SCALE)


PRESETS: dict[str, BakeMapsConfig] = {
    "tiny": BakeMapsConfig(pitch=0.02),
    "draft": BakeMapsConfig(),
    "balanced": BakeMapsConfig(pitch=0.004),
    "paper": BakeMapsConfig(pitch=2.0 / 1024),
}

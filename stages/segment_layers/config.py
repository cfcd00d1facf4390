"""Configuration of `gw segment-layers`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import PICTURE_SCALE, option

LABEL_SOURCES = ("auto", "images", "scan")


@dataclass(frozen=True)
class SegmentLayersConfig:
    """How the template is split into layers.

    Attributes:
        labels: "images" (vote of the label images), "scan" (labels that came with the scan) or "auto"
            (images where there are any, else scan).
        smoothness: cost of a label border, per edge, against the cost of disagreeing with the votes.
        expansions: sweeps of the graph cut over all labels.
        smallest_island_m2: patches of a label smaller than this take the label around them.
        smallest_share: a garment that covers less of the template's area than this is taken for absent.
        extended_rings: rings of faces by which a garment reaches under its neighbour.
        beneath_m: how far a garment continues under one that lies over it, also on separate pieces.
        beneath_outer_m: the same for an upper garment under an outer one, such as a shirt under a vest.
        ring_depth_m: how much deeper each further ring lies.
        picture_scale: size at which pictures are looked at, 1 is the capture's; 0 for the size at which the
            distance of two vertices covers two to three pixels.
    """

    labels: str = option(
        "auto",
        "auto | images | scan: vote of the label images, or labels of the scan.",
        choices=LABEL_SOURCES,
    )
    smoothness: float = 1.0
    expansions: int = 2
    smallest_island_m2: float = 0.003
    smallest_share: float = 0.005
    extended_rings: int = 2
    beneath_m: float = 0.02
    beneath_outer_m: float = 0.25
    ring_depth_m: float = 0.002
    picture_scale: float = option(0.0, **PICTURE_SCALE)


PRESETS: dict[str, SegmentLayersConfig] = {
    "tiny": SegmentLayersConfig(),
    "draft": SegmentLayersConfig(),
    "balanced": SegmentLayersConfig(),
    "paper": SegmentLayersConfig(),
}

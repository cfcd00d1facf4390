"""Sizes and kinds of a layer's model; light, so that command lines can read presets without torch."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.layers import BODY
from stages.shared.option import option

NETWORKS = ("all", "garments", "none")


@dataclass(frozen=True)
class ModelConfig:
    """Shape of one layer's model; the defaults are the economical ones, `PAPER_MODEL` the published ones.

    Attributes:
        decoder: "styleunet" (the published networks) or "blendshapes" (bases per texel, driven by the pose).
        ranks: of blendshapes: numbers of bases for offsets, colours and form.
        heads: "joint" (one network, 14 channels) or "separate" (the published three: colour 3, offset 3,
            other 8).
        networks: which layers have them: "all", "garments" (the body follows its bones and keeps its base
            attributes) or "none" (anchors alone move garments).
        width: multiplier of the networks' feature widths. depth: encoder levels. style: length of the style.
        factor: texels per network input pixel; 2 is the published ratio, more is cheaper (the output is
            sampled bilinearly).
        input_views: "front" or "both".
        normalise: the network sees how far a pose departs from the mean training pose, in units of the usual
            departure (`StyleUNetDecoder.fit_input`), instead of positions in metres.
        anchors: poses whose offsets are learned freely and blended by likeness, for garments (the body
            follows its bones); 0 for none. At most the number of training frames. anchor_cell: texels per
            cell of their coarse maps. anchor_widths: "shared", one kernel width for all anchors, or "own", as
            the poses around each are near or far. history: memories of recent motion by which anchors tell
            poses apart (`stages/shared/avatar/pose.py`); 0 for the pose alone.
        pose_prior: directions of the PCA of positional maps on which poses unlike the training's are
            projected for the networks (`stages/shared/avatar/pose_prior.py`); 0 for none. pose_sigma:
            standard deviations that such a pose may depart along each.
        base: learn free attributes per texel in addition to the networks.
        color: "sigmoid" bounds colours to 0..1, "linear" leaves them unbounded (published).
        view_conditioning: colours see the cosine between normal and viewing direction (separate heads only).
        offset_scale: metres per unit of network output. max_scale: m, ceiling of a Gaussian; 0 for none.
    """

    decoder: str = option(
        "styleunet",
        "styleunet (the published networks, and key poses) | blendshapes (bases per texel, driven by the "
        "pose: play in real time; without tracking).",
    )
    ranks: tuple[int, int, int] = option(
        (24, 8, 4), "Of blendshapes: numbers of bases for offsets, colours and form."
    )
    heads: str = "joint"
    networks: str = option("all", "Which layers have networks: all | garments | none.")
    width: float = option(
        0.125, "Multiplier of the networks' widths; 1 is the published.",
        flag="--network-width", min=0.03125, max=4,
    )  # fmt: skip
    depth: int = 4
    style: int = 64
    factor: int = 4
    input_views: str = "both"
    normalise: bool = True
    anchors: int = 0
    anchor_cell: int = 4
    anchor_widths: str = "shared"
    history: int = option(
        0,
        "Memories of recent motion (fading in 0.1, 0.3, 0.9 … s) that garments see in addition to the pose; "
        "0 for the pose alone. Still poses have no motion.",
        min=0, max=6,
    )  # fmt: skip
    pose_prior: int = 0
    pose_sigma: float = 2.0
    base: bool = True
    color: str = "sigmoid"
    view_conditioning: bool = False
    offset_scale: float = 0.05
    max_scale: float = 0.03

    def networks_of(self, layer: str) -> tuple[int, ...]:
        """Output channels of every network that a layer has."""
        if self.networks == "none" or (self.networks == "garments" and layer == BODY):
            return ()
        return (14,) if self.heads == "joint" else (3, 3, 8)


PAPER_MODEL = ModelConfig(
    heads="separate",
    width=1.0,
    depth=6,
    style=512,
    factor=2,
    input_views="front",
    normalise=False,
    pose_prior=20,
    base=False,
    color="linear",
    view_conditioning=True,
    max_scale=0.0,
)

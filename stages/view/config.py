"""Settings of `gw view`; light."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class ViewConfig:
    """How the viewer is reached, and what it shows at first. The help of each option is in its metadata.

    Attributes:
        width, height: of the first view, pixels; they decide how far away the camera stands.
    """

    host: str = option(
        "127.0.0.1", "Address to listen on; beyond this machine a token is asked for.", panel="Address"
    )
    port: int = option(8770, "0 takes a free one.", min=0, max=65535, panel="Address")
    betas: str = option("", "Another body shape: up to ten numbers, 0.5,-1.2.")
    fps: float = option(0.0, "Frames per second; 0 keeps the motion's own.", min=0)
    swap: bool = option(
        True, "Under a garment, give the body the offsets and rotations of the garment's source."
    )
    distilled: bool = option(
        False,
        "Of a subject: use the blendshapes of `gw distill`, which play in real time.",
        flag="--distilled",
    )
    drive: str = option(
        "auto",
        "What moves garments: auto | bones | learned | simulated | own-size; by layer: "
        "lower=bones,upper=learned.",
    )
    width: int = 480
    height: int = 640

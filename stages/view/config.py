"""Settings of `gw view`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ViewConfig:
    """How the viewer is reached, and what it shows at first.

    Attributes:
        host: address to listen on; anything but the machine itself asks for a token.
        port: 0 takes a free one.
        betas: up to ten shape coefficients "0.5,-1", "" for the body's own.
        fps: resample motions to this rate; 0 keeps their own.
        swap: beneath a garment, give the body the form of the garment's own source.
        distilled: of a subject, show the blendshapes of `gw distill` instead of the networks.
        drive: what moves garments, as in `gw render`.
        width, height: of the first view, pixels; they decide how far away the camera stands.
    """

    host: str = "127.0.0.1"
    port: int = 8770
    betas: str = ""
    fps: float = 0.0
    swap: bool = True
    distilled: bool = False
    drive: str = "auto"
    width: int = 480
    height: int = 640

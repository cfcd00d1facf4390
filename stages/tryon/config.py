"""Settings of `gw tryon`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TryonConfig:
    """How an outfit is worn and shown.

    Attributes:
        betas: up to ten shape coefficients "0.5,-1", "" for the body bundle's own.
        frames: rows of the pose file "START:END:STEP", "" for all.
        fps: resample the motion to this rate; 0 keeps its own.
        camera: "static" or "orbit". width, height: pixels.
        background: white, black, grey or #rrggbb, behind film and contact sheet.
        swap: beneath a garment, give the body the form of the garment's own source.
        push: let garments of other people give way to the body.
        restore: skin that is bare now, and was covered when it was learned, looks like the skin around.
        penetration: repair pixels where an inner layer pokes through a garment.
        ground: fit the way of the hips to the length of the wearer's legs, so that the feet are on the floor.
        cull: in a long film, leave out body Gaussians that nobody can see beneath garments.
        passes: of "labels", "depth", "layers".
    """

    betas: str = ""
    frames: str = ""
    fps: float = 0.0
    camera: str = "static"
    width: int = 480
    height: int = 640
    background: str = "white"
    swap: bool = True
    push: bool = False
    restore: bool = True
    penetration: bool = True
    ground: bool = True
    cull: bool = True
    passes: tuple[str, ...] = ()


PRESETS: dict[str, TryonConfig] = {
    "tiny": TryonConfig(width=120, height=160),
    "draft": TryonConfig(),
    "balanced": TryonConfig(width=720, height=960),
    "paper": TryonConfig(width=1024, height=1024),
}

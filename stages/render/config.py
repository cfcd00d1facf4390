"""Settings of `gw render`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RenderConfig:
    """What is shown and written.

    Attributes:
        betas: up to ten shape coefficients "0.5,-1", "" for the body's own.
        frames: rows of the pose file "START:END:STEP", "" for all.
        fps: resample the motion to this rate; 0 keeps its own.
        camera: "static", "orbit", or the name of one camera of the capture.
        take: which take of the capture, "" for its only (test) take.
        width, height: pixels, for "static" and "orbit".
        background: white, black, grey or #rrggbb, behind film and contact sheet.
        distilled: of a subject, show the blendshapes of `gw distill` instead of the networks.
        layers: only these; () for all.
        swap: beneath a garment, give the body the form of the garment's own source.
        penetration: repair pixels where an inner layer pokes through a garment.
        passes: of "labels", "depth", "layers".
    """

    betas: str = ""
    frames: str = ""
    fps: float = 0.0
    camera: str = ""
    take: str = ""
    width: int = 480
    height: int = 640
    background: str = "white"
    distilled: bool = False
    layers: tuple[str, ...] = ()
    swap: bool = True
    penetration: bool = True
    passes: tuple[str, ...] = ()


PRESETS: dict[str, RenderConfig] = {
    "tiny": RenderConfig(width=120, height=160),
    "draft": RenderConfig(),
    "balanced": RenderConfig(width=720, height=960),
    "paper": RenderConfig(width=1024, height=1024),
}

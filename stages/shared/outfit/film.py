"""Settings that every film of an outfit has; light."""

from __future__ import annotations

from dataclasses import dataclass, field

from stages.shared.splat.settings import ALPHA_MIN, TRANSMITTANCE_MIN


@dataclass(frozen=True)
class FilmConfig:
    """How an outfit is worn and shown.

    Attributes:
        betas: up to ten shape coefficients "0.5,-1", "" for the body's own.
        frames: rows of the pose file "START:END:STEP", "" for all.
        fps: resample the motion to this rate; 0 keeps its own.
        width, height: pixels, for all but a capture's cameras.
        background: white, black, grey, #rrggbb, transparent or a picture, behind film and contact sheet.
        swap: beneath a garment, give the body the form of the garment's own source.
        push: let garments of other people give way to the body.
        restore: skin that is bare now, and was covered when it was learned, looks like the skin around.
        penetration: repair pixels where an inner layer pokes through a garment.
        ground: fit the way of the hips of a motion from a file to the length of the wearer's legs, so that
            the feet are on the floor; not before the cameras of a capture.
        cull: in a long film, leave out body Gaussians that nobody can see beneath garments.
        alpha_min, transmittance_min: where splatting stops (`SplatSettings`); larger is faster and coarser.
        passes: of "labels", "depth", "layers".
        shard: "i/n", the part of the frames that this run makes; "" for all.
    """

    betas: str = ""
    frames: str = ""
    fps: float = 0.0
    width: int = 480
    height: int = 640
    background: str = "white"
    swap: bool = True
    push: bool = False
    restore: bool = True
    penetration: bool = True
    ground: bool = True
    cull: bool = True
    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN
    passes: tuple[str, ...] = ()
    shard: str = field(default="", metadata={"affects_result": False})


# Width and height of each preset.
FILM_SIZES: dict[str, tuple[int, int]] = {
    "tiny": (120, 160),
    "draft": (480, 640),
    "balanced": (720, 960),
    "paper": (1024, 1024),
}

"""Settings of `gw render`; light."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class RenderConfig:
    """What is shown and written.

    Attributes:
        betas: up to ten shape coefficients "0.5,-1", "" for the body's own.
        frames: rows of the pose file "START:END:STEP", "" for all.
        fps: resample the motion to this rate; 0 keeps its own.
        camera: "static", "orbit", the name of one camera of the capture, or a JSON file (camera_path.py).
        turns: how often "orbit" walks around; negative the other way.
        take: which take of the capture, "" for its only (test) take.
        width, height: pixels, for all but a capture's cameras.
        background: white, black, grey, #rrggbb, transparent or a picture, behind film and contact sheet.
        distilled: of a subject, show the blendshapes of `gw distill` instead of the networks.
        layers: only these; () for all.
        swap: beneath a garment, give the body the form of the garment's own source.
        push: let garments of other people give way to the body.
        restore: skin that is bare now, and was covered when it was learned, looks like the skin around.
        penetration: repair pixels where an inner layer pokes through a garment.
        ground: fit the way of the hips of a motion from a file to the length of the wearer's legs, so that
            the feet are on the floor; not before the cameras of a capture.
        cull: in a long film, leave out body Gaussians that nobody can see beneath garments.
        passes: of "labels", "depth", "layers".
        video: "auto" (H.264, or VP9 where there is no encoder or the background is transparent), "h264",
            "vp9" or "none".
        exports: of "ply", "spz", "glb": the Gaussians of every frame.
        pictures: whether there are pictures, or exports only.
        shard: "i/n", the part of the frames that this run makes; "" for all.
    """

    betas: str = ""
    frames: str = ""
    fps: float = 0.0
    camera: str = ""
    turns: float = 1.0
    take: str = ""
    width: int = 480
    height: int = 640
    background: str = "white"
    distilled: bool = False
    layers: tuple[str, ...] = ()
    swap: bool = True
    push: bool = False
    restore: bool = True
    penetration: bool = True
    ground: bool = True
    cull: bool = True
    passes: tuple[str, ...] = ()
    video: str = "auto"
    exports: tuple[str, ...] = ()
    pictures: bool = True
    shard: str = field(default="", metadata={"affects_result": False})


PRESETS: dict[str, RenderConfig] = {
    "tiny": RenderConfig(width=120, height=160),
    "draft": RenderConfig(),
    "balanced": RenderConfig(width=720, height=960),
    "paper": RenderConfig(width=1024, height=1024),
}

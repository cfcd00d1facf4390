"""Options of `gw tryon` and `gw render`, and their presets. Loads nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option
from stages.shared.splat.settings import ALPHA_MIN, TRANSMITTANCE_MIN


@dataclass(frozen=True)
class RenderConfig:
    """How an outfit is worn, posed, seen and written. The help of each field is in its metadata."""

    betas: str = option("", "Another body shape: up to ten numbers, 0.5,-1.2.", panel="Body and motion")
    frames: str = option("", "Only these rows of the motion, as a slice: 10:90:2.", panel="Body and motion")
    fps: float = option(0.0, "Frames per second; 0 keeps the motion's own.", min=0, panel="Body and motion")
    camera: str = option(
        "", "static | orbit | PATH.json; with `gw render --cameras` the name of one camera.", panel="Camera"
    )
    turns: float = option(1.0, "How often orbit walks around; negative turns the other way.", panel="Camera")
    take: str = option("", "With --cameras: which take of the capture.", panel="Camera")
    width: int = option(480, "Pixels.", min=16, max=8192, panel="Camera")
    height: int = option(640, "Pixels.", min=16, max=8192, panel="Camera")
    background: str = option(
        "white",
        "Behind video and contact sheet: white | black | grey | #rrggbb | transparent | a PNG or JPEG.",
        panel="Output",
    )
    distilled: bool = option(
        False,
        "Of a subject: use the blendshapes of `gw distill`, which play in real time.",
        flag="--distilled",
        panel="Layers",
    )
    layers: tuple[str, ...] = option((), "Only these layers, e.g. body,lower.", panel="Layers")
    passes: tuple[str, ...] = option((), "Also write: labels,depth,layers.", panel="Output")
    video: str = option("auto", "auto | h264 | vp9 | none.", panel="Output")
    exports: tuple[str, ...] = option(
        (), "Also write every frame's Gaussians: ply,spz,glb.", flag="--export", panel="Output"
    )
    up: str = option(
        "auto", "Axis that points up in exports: auto (-y in ply, y in spz and glb) | y | -y.", panel="Output"
    )
    pictures: bool = option(True, "Write pictures and video, or exports only.", panel="Output")
    swap: bool = option(
        True,
        "Under a garment, give the body the offsets and rotations of the garment's source.",
        panel="Layers",
    )
    push: bool = option(False, "Move garments of other people out of the wearer's body.", panel="Layers")
    restore: bool = option(
        True, "Give skin that clothes covered during training the look of the skin around it.", panel="Layers"
    )
    drive: str = option(
        "auto",
        "What moves garments: auto | bones | learned | simulated | own-size (simulated in the size of the "
        "person it was learned from); by layer: lower=bones,upper=learned.",
        panel="Body and motion",
    )
    penetration: bool = option(
        True, "Correct pixels where an inner layer pokes through a garment.", panel="Layers"
    )
    ground: bool = option(
        True,
        "Keep the feet on the floor when the wearer's legs are longer or shorter.",
        panel="Body and motion",
    )
    cull: bool = option(
        True, "Leave out body Gaussians that garments hide (from 300 pictures on).", panel="Speed"
    )
    alpha_min: float = option(
        ALPHA_MIN, "A Gaussian counts where its alpha reaches this; larger is faster, coarser.",
        min=1e-6, max=0.5, panel="Speed",
    )  # fmt: skip
    transmittance_min: float = option(
        TRANSMITTANCE_MIN,
        "A pixel stops when less light than this comes from behind; larger is faster, coarser.",
        min=0, max=0.5, panel="Speed",
    )  # fmt: skip
    shard: str = option(
        "",
        "Only the i-th of n parts of the frames, as 2/4; see below.",
        metavar="I/N",
        affects_result=False,
        panel="Speed",
    )


PRESETS: dict[str, RenderConfig] = {
    name: RenderConfig(width=width, height=height)
    for name, width, height in (
        ("tiny", 120, 160),
        ("draft", 480, 640),
        ("balanced", 720, 960),
        ("paper", 1024, 1024),
    )
}

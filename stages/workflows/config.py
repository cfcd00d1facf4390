"""Settings of `gw bench playback`. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from stages.shared.option import option


@dataclass(frozen=True)
class PlaybackConfig:
    """Settings of a playback measurement. The help of each option is in its metadata.

    Attributes:
        plain_frames: number of frames on the plain path (`Outfit.composite`), for comparison.
    """

    frames: int = option(60, "Frames that are timed, spread evenly over the motion.", min=1)
    size: int = option(512, "Pixels, width and height.", min=16, max=8192)
    camera: str = option("static", "static | orbit.", choices=("static", "orbit"))
    threads: int = option(0, "Frames at a time; 0: one per core.", min=0)
    cull: bool = option(True, "Leave out body Gaussians that nobody can see under garments.")
    plain_frames: int = 5

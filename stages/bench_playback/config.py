"""Settings of `gw bench playback`; light."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BenchPlaybackConfig:
    """What is played.

    Attributes:
        frames: frames that are timed, evenly spread over the motion and played in order.
        size: pixels, width and height.
        camera: static or orbit.
        plain_frames: frames of the plain way (`Outfit.composite`), for comparison.
        cull: leave out body Gaussians that nobody can see; found before the clock starts.
        threads: frames at a time; 0 for as many as torch uses threads.
    """

    frames: int = 60
    size: int = 512
    camera: str = "static"
    plain_frames: int = 5
    threads: int = 0
    cull: bool = True

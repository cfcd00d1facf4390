"""Configuration of `gw import`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

UPS = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")
MASKS = ("auto", "folder", "alpha", "background", "network")


@dataclass(frozen=True)
class ImportConfig:
    """How pictures and calibration become a capture.

    Attributes:
        take: name of the take.
        fps: frames per second of the take; None takes the videos' own rate.
        frames: (start, stop, step) of the frames that are kept; stop None is the end.
        test_frames: the last so many frames become a test take of their own.
        offsets: camera name to seconds by which its recording began later than the others'.
        held_out: names of the cameras that are for judging only.
        up: axis of the calibration's world that points up, or "auto".
        metres_per_unit: length of the calibration's unit, or None.
        alpha: 0 keeps only pixels that a distorted picture has, 1 keeps all of its pixels.
        masks: where masks come from: one of `MASKS`.
        background: picture, video or folder of the empty scene.
        sharp_edges: whether edges of masks are moved to edges of the picture.
        landmarks: whether body landmarks are looked for; None does so where the networks are installed.
        refine_cameras: whether the cameras' poses are improved by the landmarks.
    """

    take: str = "take"
    fps: float | None = None
    frames: tuple[int, int | None, int] = (0, None, 1)
    test_frames: int = 0
    offsets: Mapping[str, float] = field(default_factory=dict)
    held_out: tuple[str, ...] = ()
    up: str = "auto"
    metres_per_unit: float | None = None
    alpha: float = 0.0
    masks: str = "auto"
    background: Path | None = None
    sharp_edges: bool = True
    landmarks: bool | None = None
    refine_cameras: bool = False

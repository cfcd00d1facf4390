"""Configuration of `gw import`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from stages.shared.option import option

UPS = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")
MASKS = ("auto", "folder", "alpha", "background", "network")


@dataclass(frozen=True)
class ImportConfig:
    """How pictures and calibration become a capture. Declared fields have their help in their metadata.

    Attributes:
        frames: (start, stop, step) of the frames that are kept; stop None is the end.
        offsets: camera name to seconds by which its recording began later than the others'.
        sharp_edges: whether edges of masks are moved to edges of the picture.
        landmarks: whether body landmarks are looked for; None does so where the networks are installed.
    """

    masks: str = option("auto", f"Where masks come from: {' | '.join(MASKS)}.", choices=MASKS)
    background: Path | None = option(  # noqa: RUF009
        None, "Picture, video or folder of the empty scene."
    )
    up: str = option("auto", f"Axis that points up: {' | '.join(UPS)}.", choices=UPS)
    metres_per_unit: float | None = option(
        None, "Length of the calibration's unit in metres, 0.001 for millimetres."
    )
    fps: float | None = option(None, "Frames per second; default: the videos' own.")
    test_frames: int = option(0, "The last so many frames become a test take.", min=0)
    held_out: tuple[str, ...] = option((), "Cameras for judging only: cam03,cam07.")
    take: str = option("take", "Name of the take.")
    alpha: float = option(0.0, "Undistortion: 0 keeps valid pixels only, 1 all of the picture.", min=0, max=1)
    refine_cameras: bool = option(
        False, "Improve the cameras' poses by body landmarks.", flag="--refine-cameras"
    )
    frames: tuple[int, int | None, int] = (0, None, 1)
    offsets: Mapping[str, float] = field(default_factory=dict)
    sharp_edges: bool = True
    landmarks: bool | None = None


PRESETS: dict[str, ImportConfig] = {"draft": ImportConfig()}

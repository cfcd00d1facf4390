"""What a reel is asked for, and what is counted while it is made."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.outfit.picture import FINE, CutOffs
from stages.shared.pictures.background import WHITE, Background

PASSES = ("labels", "depth", "layers")


@dataclass(frozen=True, eq=False)
class ReelFrame:
    """One moment: the row of the pose file, and the cameras that see it."""

    row: int
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class ReelConfig:
    """What is written.

    Attributes:
        background: behind film and contact sheet; the frames are transparent.
        passes: of `PASSES`.
        penetration: tolerances of the penetration pass, None to leave it out.
        film: name of the video without its suffix. video: of `VIDEOS`.
        camera_folders: one folder per camera, as a capture has them.
        exports: splat formats to write every frame's Gaussians in.
        pictures: whether there are pictures at all, or exports only.
        cull: leave out body Gaussians that nobody can see (`stages/shared/outfit/hidden.py`) in a film long
            enough for that to pay; never where the body alone is shown or exported.
        cutoffs: of the splatting.
    """

    background: Background = WHITE
    passes: tuple[str, ...] = ()
    penetration: PenetrationConfig | None = None
    film: str = "film"
    video: str = "auto"
    camera_folders: bool = False
    exports: tuple[str, ...] = ()
    pictures: bool = True
    cull: bool = True
    cutoffs: CutOffs = FINE


@dataclass
class ReelSummary:
    """Counts and times of a reel.

    `seconds` are those of every frame, by part; `wall` what posing and rendering took when frames were made
    side by side (so many frames at a time, each in so many seconds).
    """

    pictures: int = 0
    wall: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    penetrated: dict[str, int] = field(default_factory=dict)
    video: str | None = None

    def add(self, other: ReelSummary) -> None:
        """Count the pictures of another one as well."""
        self.pictures += other.pictures
        self.wall += other.wall
        for mine, theirs in ((self.seconds, other.seconds), (self.penetrated, other.penetrated)):
            for name, number in theirs.items():
                mine[name] = mine.get(name, 0) + number  # type: ignore[assignment]

    def clock(self, name: str, started: float) -> None:
        """Add the time since `started` (perf_counter) to a part of the work."""
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    @property
    def rendering(self) -> float:
        """Seconds of posing and of pictures, without files."""
        return self.seconds.get("pose", 0.0) + self.seconds.get("render", 0.0)

    def as_dict(self) -> dict[str, Any]:
        """For result.json; penetrated pixels are totals over all pictures."""
        return {
            "pictures": self.pictures,
            "penetrated_pixels": self.penetrated,
            "video": self.video,
            "frames_per_second": round(self.pictures / self.wall, 2) if self.wall else None,
            "seconds": {name: round(value, 3) for name, value in self.seconds.items()},
        }


def check_passes(passes: tuple[str, ...]) -> None:
    """Raise UsageProblem for a pass that does not exist."""
    unknown = [name for name in passes if name not in PASSES]
    if unknown:
        raise UsageProblem(
            f"There is no pass called {unknown[0]!r}.",
            "option --passes",
            "Choose of: " + ", ".join(PASSES) + ".",
        )

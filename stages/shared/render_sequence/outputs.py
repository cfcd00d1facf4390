"""What a render sequence writes, and what is counted while it is rendered."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from stages.shared.capture.camera import Camera
from stages.shared.errors import UsageProblem
from stages.shared.outfit.penetration import PenetrationConfig
from stages.shared.pictures.background import WHITE, Background
from stages.shared.splat.settings import SplatSettings

PASSES = ("labels", "depth", "layers")


@dataclass(frozen=True, eq=False)
class SequenceFrame:
    """One moment: the row of the pose file, and the cameras that see it."""

    row: int
    cameras: tuple[Camera, ...]


@dataclass(frozen=True)
class SequenceOutputs:
    """What is written.

    Attributes:
        background: behind video and contact sheet; the frames are transparent.
        passes: of `PASSES`.
        penetration: tolerances of the penetration pass, None to leave it out.
        video_name: name of the video without its suffix. video: of `VIDEOS`.
        camera_folders: one folder per camera, as a capture has them.
        exports: splat formats in which every frame's Gaussians are written. up: their axis that points up,
            of `stages.shared.export.splats.UPS`.
        pictures: whether pictures are written, or exports only.
        cull: leave out hidden body Gaussians (`stages/shared/outfit/visibility_culling.py`) in a sequence
            that is long enough for that to pay; never where the body alone is shown or exported.
        splatting: cut-offs.
    """

    background: Background = WHITE
    passes: tuple[str, ...] = ()
    penetration: PenetrationConfig | None = None
    video_name: str = "film"
    video: str = "auto"
    camera_folders: bool = False
    exports: tuple[str, ...] = ()
    up: str = "auto"
    pictures: bool = True
    cull: bool = True
    splatting: SplatSettings = field(default_factory=SplatSettings)


@dataclass
class SequenceSummary:
    """Counts and times of a render sequence.

    `seconds` are summed over frames, by part. `wall` is the time that posing and rendering took when several
    frames were rendered at the same time.
    """

    pictures: int = 0
    wall: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    penetrated: dict[str, int] = field(default_factory=dict)
    video: str | None = None

    def add(self, other: SequenceSummary) -> None:
        """Add the counts of another summary."""
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
        """Seconds of posing and rendering, without files."""
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


def video_rate(fps: float, frames: Sequence[SequenceFrame]) -> float:
    """Frames per second at which the frames show the motion at its own speed.

    Arguments:
        fps: of the motion. frames: rows of it; of every second row, the rate is half.
    """
    steps = sorted(abs(after.row - before.row) for before, after in itertools.pairwise(frames))
    return fps / max(1, steps[len(steps) // 2]) if steps else fps


def check_passes(passes: tuple[str, ...]) -> None:
    """Raise UsageProblem for a pass that does not exist."""
    unknown = [name for name in passes if name not in PASSES]
    if unknown:
        raise UsageProblem(
            f"There is no pass called {unknown[0]!r}.",
            "option --passes",
            "Choose of: " + ", ".join(PASSES) + ".",
        )
